"""What can be wrong with a machine or an installation, found before a log is at stake."""
