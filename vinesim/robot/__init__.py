"""Robots: descriptions, drives, controllers and tasks."""
