"""The command line: `main` chooses the verb, a module `..._cmds` or `..._cmd` holds each."""
