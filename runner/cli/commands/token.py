"""`dualtaxi token`: the access tokens of a server."""

from __future__ import annotations

import click

from runner.analysis.sections import Grid
from runner.cli.command import CommandGroup, argument, option
from runner.cli.output import Remark, Reply
from runner.service.settings import tokens_file


@click.group("token", cls=CommandGroup)
def token_command() -> None:
    """Create, list and revoke access tokens.

    They are stored as hashes, in the configuration folder of the user who runs the server.

    Examples:
      dualtaxi token create laptop
      dualtaxi token ls
      dualtaxi token revoke laptop
    """


@token_command.command("create")
def create(
    name: str = argument(),
    scope: str = option(
        "--scope",
        type=click.Choice(("read", "write")),
        default="read",
        show_default=True,
        help="What the token allows; writing includes reading.",
    ),
) -> Reply:
    """Create a token called NAME and print it, once: only its hash is stored.

    Examples:
      dualtaxi token create laptop
      dualtaxi token create pusher --scope write
    """
    from runner.service.tokens import READ, WRITE, Tokens

    scopes = (READ, WRITE) if scope == WRITE else (READ,)
    token, secret = Tokens(tokens_file()).create(name, scopes)
    remark = Remark(f"Keep it; it is not shown again. `dualtaxi token revoke {token.id}` revokes it.")
    return Reply(token.as_json() | {"token": secret}, [secret, remark])


@token_command.command("ls")
def ls() -> Reply:
    """List the tokens; only their hashes are stored.

    Example:
      dualtaxi token ls
    """
    from runner.service.tokens import Tokens

    tokens = Tokens(tokens_file()).all()
    rows = [(token.id, token.name, " ".join(token.scopes), token.created) for token in tokens]
    headings = ("id", "name", "scopes", "created")
    listed = Grid(headings, rows, left=headings, cut=("name",))
    nothing = Remark("No tokens yet. `dualtaxi token create NAME` makes one.")
    return Reply({"tokens": [token.as_json() for token in tokens]}, [listed if tokens else nothing])


@token_command.command("revoke")
def revoke(which: str = argument(metavar="TOKEN")) -> Reply:
    """Revoke a token by its id or name; a running server refuses it from now on.

    Example:
      dualtaxi token revoke laptop
    """
    from runner.service.tokens import Tokens

    token = Tokens(tokens_file()).revoke(which)
    return Reply(token.as_json(), [Remark(f"Revoked {token.id} ({token.name}).")])
