"""An ONNX policy on onnxruntime and numpy alone: torch is not needed, and not imported.

`python -m cotap.deployment.policy FILE.onnx` prints how long an inference takes.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cotap.checks import reason_of, shortened
from cotap.deployment.metadata import INPUT, LAW_TARGETS, TARGETS, PolicyError, PolicyMetadata, read_metadata
from cotap.deployment.onnx_file import require_plain_graph
from cotap.inputs import InputError, read_bytes

_LARGEST = 2 << 30
"""Bytes that an ONNX file can have."""
FIRST_S = 10.0
"""How long a policy's first inference may take, thousands of times what it should [s]."""


class OnnxPolicy:
    """Observation in, joint targets out, and with learned modulation what is asked of the arms' laws, on one CPU
    thread.

    Args:
        path: What `cotap export` wrote.

    Raises:
        PolicyError: the file is missing, is not ONNX, has weights in another file or not finite, or loops, lacks
            metadata, is another network than that describes, or takes longer than `FIRST_S`.
        ModuleNotFoundError: onnxruntime is not installed.
    """

    metadata: PolicyMetadata

    def __init__(self, path: Path | str) -> None:
        import onnxruntime

        where = f"policy {str(path)!r}"
        try:
            data = read_bytes(path, _LARGEST)
        except InputError as error:
            raise PolicyError(f"{where} {error}") from error
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 4  # what goes wrong is raised; it need not be printed as well
        options.add_session_config_entry("session.load_model_format", "ONNX")  # not onnxruntime's own
        try:
            require_plain_graph(data)
            # Constant folding happens while loading and cannot be interrupted: it stays off until a first inference
            # has shown that the graph is fast enough.
            self._session = onnxruntime.InferenceSession(
                data, options, providers=["CPUExecutionProvider"], disabled_optimizers=["ConstantFolding"]
            )
            properties = self._session.get_modelmeta().custom_metadata_map
            inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        except Exception as error:  # onnxruntime's errors share no base but this
            raise PolicyError(f"{where} cannot be read as ONNX: {reason_of(error)}") from error
        self.metadata = read_metadata(where, properties)
        joints, width = len(self.metadata.joints), self.metadata.observation_width
        self._require(where, "inputs", inputs, {INPUT: [1, width]})
        modulated = len(self.metadata.law_targets)
        self._outputs = {TARGETS: [1, joints], LAW_TARGETS: [1, modulated]} if modulated else {TARGETS: [1, joints]}
        self._require(where, "outputs", outputs, self._outputs)
        self._input = np.zeros((1, width), dtype=np.float32)
        self._default = np.array(self.metadata.default_pose_rad)
        self._scale = np.array(self.metadata.action["scale_rad"])
        self._residual = self.metadata.action["upper_mode"] == "residual"
        self._infer_within(where, FIRST_S)
        self._session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Joint targets (J,) [rad], float64, of an observation (width,); with residual arms, of the reference that was
        observed. With learned modulation (J + M,): behind them, what the metadata's `law_targets` names."""
        self._input[0] = observation
        found = self._session.run(list(self._outputs), {INPUT: self._input})
        return np.concatenate([np.asarray(part, dtype=np.float64)[0] for part in found])

    def offset(self, arm_reference: np.ndarray) -> np.ndarray:
        """What scaled actions are added to (J,) [rad], for the arms' reference (U,) [rad]."""
        if not self._residual:
            return self._default
        return np.concatenate((self._default[: -len(arm_reference)], arm_reference))

    def action(self, targets: np.ndarray, arm_reference: np.ndarray) -> np.ndarray:
        """The action (J,) behind targets (J,) [rad] that were sent with the arms' reference (U,) [rad]."""
        return (targets - self.offset(arm_reference)) / self._scale

    def _infer_within(self, where: str, seconds: float) -> None:
        """One inference. Raises PolicyError if it fails, or takes longer."""
        import onnxruntime

        options = onnxruntime.RunOptions()
        timer = threading.Timer(seconds, setattr, (options, "terminate", True))
        timer.start()
        try:
            self._session.run(list(self._outputs), {INPUT: self._input}, options)
        except Exception as error:  # as above
            late = options.terminate
            reason = f"took more than {seconds:g} s" if late else f"failed: {shortened(reason_of(error))}"
            raise PolicyError(f"{where} cannot be used: its first inference {reason}") from error
        finally:
            timer.cancel()

    @staticmethod
    def _require(where: str, kind: str, found: Sequence[Any], wanted: dict[str, list[int]]) -> None:
        got = {value.name: value.shape for value in found if value.type == "tensor(float)"}
        if got != wanted:
            shown = {value.name: (value.type, value.shape) for value in found}
            raise PolicyError(f"{where} has {kind} {shown}; its metadata asks for float32 {wanted}")


def inference_ms(policy: OnnxPolicy, calls: int = 2000) -> tuple[float, float]:
    """Median and 99th percentile of the time of one call [ms], on one CPU thread, observations differing."""
    rng = np.random.default_rng(0)
    observations = rng.normal(size=(64, policy.metadata.observation_width)).astype(np.float32)
    seconds = np.zeros(calls)
    for i in range(-50, calls):  # the first are slower
        begin = time.perf_counter()
        policy(observations[i % 64])
        if i >= 0:
            seconds[i] = time.perf_counter() - begin
    return 1e3 * float(np.median(seconds)), 1e3 * float(np.percentile(seconds, 99.0))


def main(argv: list[str] | None = None) -> int:
    """Time the policy that is named. Returns the exit status: 0, or 2 for bad input."""
    args = sys.argv[1:] if argv is None else argv
    if len(args) != 1 or args[0].startswith("-"):
        print("usage: python -m cotap.deployment.policy FILE.onnx")
        return 0 if args in (["-h"], ["--help"]) else 2
    try:
        median, late = inference_ms(OnnxPolicy(args[0]))
    except (PolicyError, ModuleNotFoundError) as error:
        print(f"error: {shortened(str(error))}", file=sys.stderr)
        return 2
    print(f"{args[0]}: inference {median:.3f} ms, 99 % within {late:.3f} ms, one thread")
    return 0


if __name__ == "__main__":
    sys.exit(main())
