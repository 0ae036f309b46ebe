"""habitat-lab's own measures, bug for bug."""
