"""Logs made of messages: MCAP files and ROS bags, read without ROS.

A recording (``recording``) yields raw messages; ``index`` keeps time and place of each; ``messages`` decodes
them, whatever their encoding; ``topics`` chooses those that a map is made from; ``source`` makes the log.
"""
