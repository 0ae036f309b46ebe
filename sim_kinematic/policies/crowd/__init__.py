"""Policies among several people: people of crowds, and robots that drive to a goal among them."""
