"""C++ implementations for the CPU, chosen at run time by instruction set."""
