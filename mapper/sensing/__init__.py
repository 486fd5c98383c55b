"""Sensor models: depth filter, depth noise, wheel kinematics."""
