"""Shafts in the frames of a recording, and what among them is furniture or a repeated picture."""
