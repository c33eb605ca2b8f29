"""The request to stop, as an exception: whoever has something to keep keeps it, and lets it pass."""

import signal


class Stopped(KeyboardInterrupt):
    """A signal asked the program to end.

    It is a `KeyboardInterrupt`, so that code that ends well on Ctrl-C ends well on SIGTERM, too.
    """

    def __init__(self, kind: signal.Signals) -> None:
        super().__init__(kind.name)
        self.signal = kind
