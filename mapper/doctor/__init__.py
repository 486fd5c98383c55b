"""Examination of a machine and an installation, before a log is built."""
