"""What the user asked for: the scene file, checked, and the plan of its samples."""
