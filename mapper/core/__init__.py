"""Data types and geometry that every other package builds on."""
