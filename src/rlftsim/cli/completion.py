"""Completion of command lines in bash and zsh: a script for the shell, which asks this program for the words."""

import io
from collections.abc import Sequence
from contextlib import redirect_stdout, suppress

from rlftsim.cli.parse import find_command, list_actions, parse
from rlftsim.cli.signatures import FLAG
from rlftsim.verbs.commands import VERBS

SCRIPT = """\
[ -n "$ZSH_VERSION" ] && autoload -U +X bashcompinit && bashcompinit
_rlftsim() {
    local words
    words=$(rlftsim --completion "${COMP_WORDS[@]:1:COMP_CWORD-1}" 2>/dev/null)
    COMPREPLY=($(compgen -W "$words" -- "${COMP_WORDS[COMP_CWORD]}"))
}
complete -o default -F _rlftsim rlftsim
"""
"""What a shell evaluates at its start. Where no word fits, it completes names of files."""


def list_next_words(words: Sequence[str]) -> list[str]:
    """Words that can follow: verbs, actions of a verb, or flags of a command.

    Args:
        words: Whole words behind `rlftsim`, without the word that is typed.
    """
    if not words:
        return list(VERBS)
    actions, name = list_actions(words[0]), find_command(words)
    text = io.StringIO()
    if name is not None:
        with redirect_stdout(text), suppress(SystemExit):
            parse([*name.split(), "--help"])
    return (actions if len(words) == 1 else []) + list(dict.fromkeys(FLAG.findall(text.getvalue())))
