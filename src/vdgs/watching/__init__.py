"""Training under the eyes of a person: shown, logged, saved, stopped and continued."""
