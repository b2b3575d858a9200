"""What a report draws: frames with the instrument marked, and the scene in three dimensions."""
