"""Readers of homes of other programs (`usd`, `procthor`) and of robots (`mjcf`, `robot_guess`)."""
