"""People: skeleton, skin, gait, arms, reaching."""
