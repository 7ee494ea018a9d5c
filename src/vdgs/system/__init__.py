"""Files that are whole or absent: text and JSON, tensors, checkpoints."""
