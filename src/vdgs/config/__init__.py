"""Every setting, what is asked of the program, and what may be wrong with either. Standard library only."""
