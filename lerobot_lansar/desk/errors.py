"""Errors that a user of the desk can cause; each message says what was expected and what to do."""


class DeskError(ValueError):
    """An unusable argument: an unknown scene, a missing asset, an action or a state of the wrong form."""


class SimulationError(RuntimeError):
    """The physics diverged: a state became infinite or NaN. The desk can be used again after a reset."""
