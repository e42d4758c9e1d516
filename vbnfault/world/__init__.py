"""What is out there: Sun and orbit, stars, spacecraft, the body under them."""
