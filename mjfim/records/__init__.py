"""Frozen arrays that verbs take and return, each with names and units."""
