"""The evidence: methods × scenes × seeds turned into tables, figures and a verdict (`vdgs bench TABLE`)."""
