"""Radiometry, incidence angles and the lidar equation."""
