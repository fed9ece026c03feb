"""Error analysis: missed, false and inaccurate boxes by view, distance, occlusion and points, with pictures."""
