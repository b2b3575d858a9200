"""What an estimate is worth: covariance, what the data cannot see, and which motion would help most."""
