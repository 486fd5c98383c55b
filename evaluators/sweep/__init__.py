"""Builds of many logs by many methods in many configurations."""
