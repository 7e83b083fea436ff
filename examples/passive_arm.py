"""An arm of your own whose stiffness may change at any time: read, ask, send, 500 times a second."""

import torch

from cotap.compliance.passivity import EnergyStore, damping_energy, hold_back

DT = 0.002  # control step [s]
INERTIA = torch.tensor([[0.30, 0.08], [0.08, 0.12]], dtype=torch.float64)
DAMPING = torch.diag(torch.tensor([0.2, 0.1], dtype=torch.float64))  # what the motors add [Nms/rad]


class Arm:
    """Two joints, simulated. In its place goes your driver, with the same two methods."""

    def __init__(self) -> None:
        self.q, self.dq, self.drawn = torch.zeros(2, dtype=torch.float64), torch.zeros(2, dtype=torch.float64), 0.0

    def read(self) -> torch.Tensor:
        return self.q.clone()

    def send(self, stiffness: torch.Tensor, target: torch.Tensor, pull: torch.Tensor) -> None:
        """Motors: `K (target - q) - D dq` for one control step; `pull` is the torque of whoever holds the hand."""
        for _ in range(10):
            torque = stiffness @ (target - self.q) - DAMPING @ self.dq + pull
            self.dq = self.dq + DT / 10 * torch.linalg.solve(INERTIA, torque)
            self.q = self.q + DT / 10 * self.dq
            self.drawn -= DT / 10 * float(pull @ self.dq)


def run(filtered: bool, steps: int = 1000) -> float:
    """Somebody swings the arm and brakes it again, while its stiffness jumps. Returns the energy drawn from it [J]."""
    arm, store, target = Arm(), EnergyStore(first=1.0, ceiling=1.0), torch.zeros(2, dtype=torch.float64)
    stiffness = torch.diag(torch.tensor([10.0, 5.0], dtype=torch.float64))
    level = torch.tensor(store.first, dtype=torch.float64)
    before = arm.read()
    for step in range(steps):
        q = arm.read()
        returning = (target - q) @ (q - before) > 0.0  # stiff on the way back, soft on the way out
        wanted = stiffness.new_tensor([[60.0, 20.0], [20.0, 30.0]]) if returning else torch.diag(target + 8.0)
        if filtered:
            level = store.filled(level, damping_energy(DAMPING, q - before, DT))
            stiffness, _, energy = hold_back(stiffness, wanted, target - q, store.available(level, DT))
            level = store.drawn(level, energy)
        else:
            stiffness = wanted
        before = q
        arm.send(stiffness, target, pull=2.0 * arm.dq.sign() + 0.1 if step < 100 else -1.0 * arm.dq)
    return arm.drawn


if __name__ == "__main__":
    print(f"energy drawn: {run(filtered=False):.1f} J without the filter, {run(filtered=True):.1f} J with it")
