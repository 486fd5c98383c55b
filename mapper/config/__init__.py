"""The configuration of a build: its model, files, overrides, and defaults per sensor."""
