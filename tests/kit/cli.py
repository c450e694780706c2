"""The command line in process."""

from typer.testing import CliRunner, Result

from gateway.cli.app import app


def invoke(*words: object, answers: str = "", code: int | None = None) -> Result:
    """Run `mavgate` with some words.

    Parameters
    ----------
    words : object
        Arguments; each is converted to text.
    answers : str, optional
        Standard input.
    code : int, optional
        The expected exit code; by default any.

    Returns
    -------
    Result
        Exit code and output.
    """
    result = CliRunner().invoke(app, [str(word) for word in words], input=answers)
    if code is not None:
        assert result.exit_code == code, result.output
    return result
