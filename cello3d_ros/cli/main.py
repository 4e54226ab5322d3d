"""``cello3d``: one verb a module; known errors become one line and exit status 1."""

from __future__ import annotations

import argparse
import errno
import importlib
import os
import sys
from collections.abc import Sequence

from cello3d_ros import __version__
from cello3d_ros.errors import Cello3dError

VERBS = {
    "estimate": "register one pair of files and predict its covariance",
    "info": "say what a model or a recording holds",
    "convert": "turn any recording into a rosbag2, a KITTI folder or plain clouds",
    "simulate": "scan a simulated world into a rosbag2",
    "align": "find reference poses from the recording itself",
    "sample": "sample ICP on every pair of recordings into a dataset",
    "train": "learn a model from datasets",
    "tune": "fit a model to one recording of your own",
    "evaluate": "judge covariances beside every baseline",
    "graph": "write registrations with covariances as a pose graph",
    "report": "turn an evaluation into one page to look at",
    "reproduce": "make the paper's tables and figures again",
    "replay": "run the estimator over a recording, without ROS",
    "demo": "replay a bag through the node and judge its answers",
}


_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb.  Returns 0, 1 for a known error, 2 for usage, 130 for Ctrl-C."""
    argv = sys.argv[1:] if argv is None else argv
    try:
        arguments = _parse(argv)
        status = int(arguments.run(arguments) or 0)
        sys.stdout.flush()
        return status
    except Cello3dError as error:
        print(f"cello3d: {error}", file=sys.stderr)
        return 1
    except (KeyboardInterrupt, SystemError) as error:
        if not _is_interrupt(error):
            raise
        print("cello3d: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:  # the reader of our output left, as `head` does
        _forget_output()
        return 0
    except OSError as error:
        if error.errno in _FULL:
            _forget_output()
            print(f"cello3d: cannot write the output: {error.strerror}", file=sys.stderr)
        elif error.filename is not None:
            print(f"cello3d: {error.filename}: {error.strerror}", file=sys.stderr)
        else:
            raise
        return 1


def _is_interrupt(error: BaseException | None) -> bool:
    """Say whether an error came of Ctrl-C.

    A compiled function that is interrupted while it takes its arguments raises SystemError, as
    often as such functions are nested; the interrupt is the first cause.
    """
    while isinstance(error, SystemError):
        error = error.__cause__
    return isinstance(error, KeyboardInterrupt)


def _forget_output() -> None:
    """Send what is still to be printed nowhere: Python would complain of it at its end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    """Parse the arguments; only the chosen verb's module is imported."""
    parser = argparse.ArgumentParser(
        prog="cello3d", description="The covariance of ICP: sample, learn, predict."
    )
    parser.add_argument("--version", action="version", version=f"cello3d {__version__}")
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="VERB")
    chosen = next((word for word in argv if not word.startswith("-")), None)
    for verb, summary in VERBS.items():
        subparser = verbs.add_parser(verb, help=summary, description=summary)
        if verb == chosen:
            module = importlib.import_module(f"cello3d_ros.cli.{verb}")
            module.add_arguments(subparser)
            subparser.set_defaults(run=module.run)
    return parser.parse_args(argv)


if __name__ == "__main__":
    sys.exit(main())
