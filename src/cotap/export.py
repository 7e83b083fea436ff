"""`cotap export`: a checkpoint as one ONNX file."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from cotap.checks import require_positive_int, require_range, require_seed, shortened
from cotap.files import require_output


@dataclass
class ExportOptions:
    """Write a policy as one ONNX file: from observation to joint targets, with the metadata that a robot's loop
    needs."""

    output: str
    """File to write (.onnx)."""
    checkpoint: str = ""
    """Policy to export: a file, or a shipped policy's name. By default what ships of --robot."""
    robot: str = ""
    """Robot whose shipped policy to take. Under compliance, if there is one; by default h1."""
    checks: int = 1000
    """Observations on which to compare file and torch. The file is kept only if they agree."""
    seed: int = 0
    """Seed of those observations."""


def main(argv: list[str] | None = None) -> int:
    """Parse, export, report. Returns the exit status: 0, 2 for bad input, 1 if the file's numbers are not torch's, or
    130 for an export that was interrupted."""
    options = tyro.cli(ExportOptions, args=argv, prog="cotap export")
    try:
        from cotap.deployment.graph import export_policy
        from cotap.evaluation.policy import find_policy

        require_range("checks", require_positive_int("checks", options.checks), 1, 1_000_000)
        require_seed("seed", options.seed)
        output = Path(options.output)
        if output.suffix != ".onnx":
            raise ValueError(f"--output must end in .onnx, got {options.output!r}")
        require_output("--output", options.output)
        path = find_policy(options.checkpoint, options.robot)
        summary, worst = export_policy(path, output, options.checks, options.seed)
    except (ValueError, OSError, ModuleNotFoundError) as error:
        print(f"error: {shortened(str(error))}", file=sys.stderr)
        return 2
    except ArithmeticError as error:
        print(f"error: {shortened(str(error))}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("interrupted: nothing was written", file=sys.stderr)
        return 130
    print(f"{output}: {summary}; differs from torch by at most {worst:.1e} over {options.checks} observations")
    return 0


if __name__ == "__main__":
    sys.exit(main())
