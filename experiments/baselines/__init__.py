"""Other methods, built on the same kernels, captures and evaluation, to be measured beside this one."""
