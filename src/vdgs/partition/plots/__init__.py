"""The figures of `vdgs partition`."""
