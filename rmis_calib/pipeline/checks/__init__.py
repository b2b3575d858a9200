"""What can be said of a recording and of an answer, in words, with likely causes."""
