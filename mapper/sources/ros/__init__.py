"""Logs made of messages: MCAP files and ROS bags, read without ROS.

A recording (``recording``) yields raw messages; ``index`` keeps when and where each lies; ``messages`` says
what they mean, whichever encoding they came in; ``topics`` chooses what a map is made from; ``source`` is the
log.
"""
