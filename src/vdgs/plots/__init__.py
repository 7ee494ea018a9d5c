"""What figures of several rooms share."""
