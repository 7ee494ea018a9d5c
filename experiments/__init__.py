"""Evidence about the package, which is not in the wheel: bench, other methods, microbenchmarks and dated reports."""
