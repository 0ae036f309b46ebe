"""Building blocks of commands: options, results, and safe output files."""

from h3data.commands.command import Command, DryRunFlag, ForceFlag, Group, JsonFlag, Outcome, claim_file, claim_folder

__all__ = ["Command", "DryRunFlag", "ForceFlag", "Group", "JsonFlag", "Outcome", "claim_file", "claim_folder"]
