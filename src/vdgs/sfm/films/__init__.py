"""Films: frames taken out of them become photographs, with positions from the subtitles of drones."""
