"""Light of the Sun that a lens sends astray: ghosts, starburst, glare, veil, and their total."""
