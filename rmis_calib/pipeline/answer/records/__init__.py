"""What a result holds of each part of the answer, and what is said of it in words."""
