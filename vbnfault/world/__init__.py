"""Describe the surroundings of the camera: Sun and orbit, stars, spacecraft, and the body."""
