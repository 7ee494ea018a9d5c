"""Photographs in: from files of a memory card to a capture that trains, georeferenced where they have positions."""
