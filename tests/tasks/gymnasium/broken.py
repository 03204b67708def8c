"""A module of somebody's that cannot be imported."""

1 / 0  # noqa: B018
