"""The one exception that means "your input, not our bug"."""


class InputError(ValueError):
    """Bad input from a person: the message names the file or value, what is wrong and what to do.

    The command line prints the message as one line and exits with code 2.
    """


def reason_in_a_line(error: object) -> str:
    """What somebody else's exception says, for the middle of a message of ours: at most 200 characters."""
    return " ".join(str(error).split())[:200] or type(error).__name__
