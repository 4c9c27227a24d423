"""Robots: descriptions, drives and motions."""
