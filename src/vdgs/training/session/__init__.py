"""Training that is watched: shown, logged, checkpointed, stopped and continued."""
