"""The command line: the only place that prints, and that turns errors into messages.

Nothing heavy is imported before a command needs it: with numpy and GTSAM ``mapfuse --help`` would take a second.
"""

from .app import main

__all__ = ["main"]
