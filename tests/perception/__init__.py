"""Tests of vinesim.perception."""
