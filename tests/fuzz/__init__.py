"""Fuzzing of everything that reads files: small valid inputs of every format, damaged in every manner."""
