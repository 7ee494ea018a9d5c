"""The command line: `main` chooses the verb, `commands` lists them, a module `..._cmd` holds each."""
