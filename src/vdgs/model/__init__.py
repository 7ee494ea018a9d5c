"""The anchor model: what anchors hold, where they start, their decoder, their file, how they are drawn and seen."""
