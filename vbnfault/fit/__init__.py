"""Compare a camera's own frames with images that a scene renders for them."""
