"""What a process takes and may take, and what training will take by estimate."""
