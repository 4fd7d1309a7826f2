"""Errors a user of the desk can cause; each message says what was expected and what to do."""


class DeskError(ValueError):
    """Something about the request is wrong: an unknown scene, a missing asset, an unusable action or state."""


class SimulationError(RuntimeError):
    """The physics diverged (a state became infinite or NaN). The desk can be used again after a reset."""
