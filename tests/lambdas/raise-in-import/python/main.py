"""A lambda that cannot be imported."""

raise RuntimeError("no, not today")
