"""Compute the Sun's straylight on the sensor: ghosts, starburst, glare, veil, and their sum."""
