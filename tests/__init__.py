"""Tests; the folders mirror the packages, `support` holds what test modules share."""
