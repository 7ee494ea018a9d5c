"""Commands that can be repeated, run side by side by an engine (`executor`) and watched through their files."""
