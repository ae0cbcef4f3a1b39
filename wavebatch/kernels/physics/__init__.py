"""Incidence angle, radiometry and the lidar equation: physics of single echoes."""
