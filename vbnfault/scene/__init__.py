"""Check the scene file, which says what the user asks for, and plan its samples."""
