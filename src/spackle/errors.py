"""The one exception that means "your input, not our bug"."""


class InputError(ValueError):
    """Bad input from a person: the message names the file or value, what is wrong and what to do.

    The command line prints the message as one line and exits with code 2.
    """
