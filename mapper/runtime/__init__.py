"""Execution: executors, resumable jobs, threads, progress, and atomic files and folders."""
