"""Where blocks are trained: commands that can be repeated, started side by side and watched through their files."""
