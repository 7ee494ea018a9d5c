"""Photographs in: from files of a memory card to a capture that trains, georeferenced where they have positions."""

# Before pycolmap: where that is loaded first, both bring a zlib of their own and Pillow's PNG encoder breaks the heap.
import PIL.Image  # noqa: F401
