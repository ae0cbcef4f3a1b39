"""Stages that compute columns from fitted echoes."""
