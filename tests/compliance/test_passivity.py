"""A stiffness that changes gives away no more than the store had at first: by closed forms, and to whoever pulls."""

from __future__ import annotations

import math

import pytest
import torch
from sprung import DT, run

from cotap.compliance import hold_back as exported
from cotap.compliance import spd_exp, spd_log
from cotap.compliance.passivity import EnergyStore, damping_energy, hold_back, rate_margin, stiffness_energy

DOUBLE = torch.float64
STORE = EnergyStore(first=0.5, floor=0.1, ceiling=0.6, power=1e6)


def random_spd(rng, *shape: int, n: int = 4, spread: float = 1.5) -> torch.Tensor:
    """(*shape, n, n) with eigenvalues between e^-spread and e^spread, times 100."""
    q, _ = torch.linalg.qr(torch.randn(*shape, n, n, dtype=DOUBLE, generator=rng))
    values = 100.0 * torch.exp(spread * (2.0 * torch.rand(*shape, n, dtype=DOUBLE, generator=rng) - 1.0))
    k = (q * values.unsqueeze(-2)) @ q.transpose(-1, -2)
    return 0.5 * (k + k.transpose(-1, -2))


def along(k_old, k_new, share):
    """The geodesic, from an eigendecomposition of `K_old^-1 K_new` that knows nothing of symmetry."""
    values, vectors = torch.linalg.eig(torch.linalg.solve(k_old, k_new))
    power = (vectors * (values**share).unsqueeze(-2)) @ torch.linalg.inv(vectors)
    return (k_old.to(power) @ power).real


def test_energy_of_a_change_is_the_difference_of_two_springs(rng):
    a, b, e = random_spd(rng, 5, 2), random_spd(rng, 5, 2), torch.randn(5, 2, 4, dtype=DOUBLE, generator=rng)
    expected = 0.5 * torch.einsum("...i,...ij,...j", e, b, e) - 0.5 * torch.einsum("...i,...ij,...j", e, a, e)
    torch.testing.assert_close(stiffness_energy(a, b, e), expected)


def test_one_spring_by_hand():
    """100 N/m at 0.1 m holds 0.5 J; 400 N/m would hold 2 J. 0.5 J more are 200 N/m, half of the way in logarithms."""
    old, new, e = torch.tensor([[100.0]]), torch.tensor([[400.0]]), torch.tensor([0.1])
    held = hold_back(old, new, e, 0.5)
    assert float(held.stiffness) == pytest.approx(200.0, rel=1e-5)
    assert float(held.share) == pytest.approx(0.5, rel=1e-5)
    assert float(held.energy) == pytest.approx(0.5, rel=1e-5)
    assert float(hold_back(old, new, e, 1.5001).stiffness) == 400.0
    assert float(hold_back(old, new, -e, 0.0).stiffness) == 100.0
    assert float(hold_back(new, old, e, 0.0).stiffness) == 100.0  # what takes energy out passes
    assert float(hold_back(new, old, e, 0.0).energy) == pytest.approx(-1.5)
    assert float(hold_back(old, new, 0.0 * e, 0.0).stiffness) == 400.0  # so does what injects none


@pytest.mark.parametrize(("dtype", "near"), [(DOUBLE, 1e-6), (torch.float32, 5e-3)])
@pytest.mark.parametrize("spread", [0.1, 1.0, 3.0])
@pytest.mark.parametrize("n", [1, 2, 4, 7])
def test_the_share_is_the_largest_one_that_bisection_finds(rng, dtype, near, spread, n):
    a, b = random_spd(rng, 400, n=n, spread=spread).to(dtype), random_spd(rng, 400, n=n, spread=spread).to(dtype)
    e = (0.1 * torch.randn(400, n, dtype=DOUBLE, generator=rng)).to(dtype)
    room = torch.rand(400, dtype=DOUBLE, generator=rng) ** 6 * stiffness_energy(a, b, e).double().abs()
    room[::4] = 0.0
    held = hold_back(a, b, e, room.to(dtype))
    room = room.to(dtype).double()
    low, high = torch.zeros(400, dtype=DOUBLE), torch.ones(400, dtype=DOUBLE)

    def within(share):
        curve = along(a.double(), b.double(), share.unsqueeze(-1))
        return stiffness_energy(a.double(), 0.5 * (curve + curve.transpose(-1, -2)), e.double()) <= room

    whole = within(high)
    for _ in range(50):
        middle = 0.5 * (low + high)
        inside = within(middle)
        low, high = torch.where(inside, middle, low), torch.where(inside, high, middle)
    share = torch.where(whole, 1.0, low)
    assert 0.2 < float((share < 1.0).double().mean()) < 0.8
    torch.testing.assert_close(held.share.double(), share, atol=near, rtol=0)
    assert (held.energy.double() <= room).all()
    torch.testing.assert_close(held.energy, stiffness_energy(a, held.stiffness, e))
    assert torch.equal(held.stiffness[held.share == 1.0], b[held.share == 1.0])
    assert float(torch.linalg.eigvalsh(held.stiffness.double()).min()) > 0.0


def test_a_direction_that_stiffens_most_and_hardly_counts_takes_no_share_away():
    """`1/2 (1e5^s - 1) 0.01^2 = 1e-4` where `1e5^s = 3`."""
    old, new = torch.eye(2, dtype=torch.float64), torch.diag(torch.tensor([1.0, 1e5], dtype=torch.float64))
    held = hold_back(old, new, torch.tensor([0.3, 0.01], dtype=torch.float64), torch.tensor(1e-4, dtype=torch.float64))
    assert float(held.share) == pytest.approx(math.log(3.0) / math.log(1e5), rel=1e-6)


def test_energy_along_the_segment_is_convex_so_that_all_smaller_shares_are_admissible(rng):
    """Along the log-Euclidean segment it is not: halfway it can be above both ends."""
    a, b = random_spd(rng, 300, spread=3.0), random_spd(rng, 300, spread=3.0)
    e = torch.randn(300, 4, dtype=DOUBLE, generator=rng)
    shares = torch.linspace(0.0, 1.0, 21, dtype=DOUBLE)
    energy = torch.stack([stiffness_energy(a, _symmetric(along(a, b, s)), e) for s in shares])
    bend = energy[:-2] + energy[2:] - 2.0 * energy[1:-1]
    assert float((bend / energy.abs().amax(0)).min()) > -1e-9
    t = math.radians(21.0)
    turn = torch.tensor([[math.cos(t), -math.sin(t)], [math.sin(t), math.cos(t)]], dtype=DOUBLE)
    old = torch.diag(torch.tensor([1000.0, 10.0], dtype=DOUBLE))
    new = _symmetric(turn @ torch.diag(torch.tensor([100.0, 1.0], dtype=DOUBLE)) @ turn.T)
    e = torch.tensor([math.cos(1.466), math.sin(1.466)], dtype=DOUBLE)
    halfway = spd_exp(_symmetric(0.5 * (spd_log(old) + spd_log(new))))
    assert float(e @ halfway @ e) > 1.15 * max(float(e @ old @ e), float(e @ new @ e))
    assert float(e @ along(old, new, 0.5) @ e) < max(float(e @ old @ e), float(e @ new @ e))


def test_the_two_segments_are_one_where_the_ends_commute(rng):
    q, _ = torch.linalg.qr(torch.randn(4, 4, dtype=DOUBLE, generator=rng))
    a, b = (_symmetric(q @ torch.diag(torch.rand(4, dtype=DOUBLE, generator=rng) + 0.1) @ q.T) for _ in range(2))
    e = torch.ones(4, dtype=DOUBLE)
    room = 0.3 * stiffness_energy(a, b, e).abs()
    held = hold_back(a, b, e, room) if stiffness_energy(a, b, e) > 0 else hold_back(b, a, e, room)
    ends = (a, b) if stiffness_energy(a, b, e) > 0 else (b, a)
    mean = (1.0 - held.share) * spd_log(ends[0]) + held.share * spd_log(ends[1])
    torch.testing.assert_close(held.stiffness, spd_exp(_symmetric(mean)), rtol=1e-8, atol=1e-9)
    assert 0.0 < float(held.share) < 1.0


def test_units_of_the_joints_do_not_matter(rng):
    """Degrees instead of radians for one joint: the same share, which no logarithm of the stiffness itself gives."""
    a, b, e = random_spd(rng, 20), random_spd(rng, 20), torch.randn(20, 4, dtype=DOUBLE, generator=rng)
    unit = torch.diag(torch.tensor([1.0, 180.0 / math.pi, 1.0, 1.0], dtype=DOUBLE))
    room = 0.1 * stiffness_energy(a, b, e).abs()
    inverse = torch.linalg.inv(unit)
    held, other = hold_back(a, b, e, room), hold_back(inverse @ a @ inverse, inverse @ b @ inverse, e @ unit, room)
    torch.testing.assert_close(other.share, held.share, rtol=1e-7, atol=1e-9)
    torch.testing.assert_close(unit @ other.stiffness @ unit, held.stiffness, rtol=1e-7, atol=1e-6)


def test_least_energy_of_damping_against_a_fine_integral(rng):
    """Equal for an even motion, less than the true energy for any other between the same ends."""
    damping, ends = random_spd(rng, 6), torch.randn(6, 4, dtype=DOUBLE, generator=rng)
    bound = damping_energy(damping, ends, 0.02)
    time = torch.linspace(0.0, 1.0, 2001, dtype=DOUBLE)
    for bump in (0.0, 0.5, 2.0):
        rate = ends * (1.0 + bump * math.pi * (math.pi * time).cos()).reshape(-1, 1, 1) / 0.02
        power = torch.einsum("t...i,...ij,t...j->t...", rate, damping, rate)
        true = torch.trapezoid(power, 0.02 * time, dim=0)
        if bump:
            assert (bound < true).all()
        else:
            torch.testing.assert_close(bound, true, rtol=1e-9, atol=0)


def test_the_store_by_hand():
    store = EnergyStore(first=1.0, floor=0.25, ceiling=1.5, power=5.0, damping_share=0.5)
    level = torch.tensor([1.0, 0.25, 1.4, 0.3])
    assert store.filled(level, torch.tensor([0.2, 0.0, 4.0, 0.1])).tolist() == pytest.approx([1.1, 0.25, 1.5, 0.35])
    assert store.available(level, 0.02).tolist() == pytest.approx([0.1, 0.0, 0.1, 0.05])
    assert store.drawn(level, torch.tensor([0.1, -0.5, -0.5, 0.05])).tolist() == pytest.approx([0.9, 0.75, 1.5, 0.25])
    assert float(store.drawn(torch.tensor(0.3), torch.tensor(0.3))) >= 0.25  # rounding does not undercut the floor


def _symmetric(m: torch.Tensor) -> torch.Tensor:
    return 0.5 * (m + m.transpose(-1, -2))


# What the commanding side may do, beside a force: all know the position and the velocity.
SOFT, STIFF = 50.0, 800.0


def knowing(step, x, v):
    """Stiff on the way back, soft on the way out: what pumps at twice the natural frequency."""
    del step
    return _scalar(torch.where((x * v).sum(-1) < 0.0, STIFF, SOFT), x)


def stretched(step, x, v):
    """Stiff while it is far out, soft while it is near."""
    del step, v
    return _scalar(torch.where(x.norm(dim=-1) > 0.02, STIFF, SOFT), x)


def wave(ratio, kind):
    """Around the mean, at a multiple of the natural frequency of the geometric mean."""
    mean = math.sqrt(SOFT * STIFF)
    rate = ratio * math.sqrt(mean)

    def wanted(step, x, v):
        del v
        phase = rate * DT * step / (2.0 * math.pi) % 1.0
        up = {"sine": math.sin(2.0 * math.pi * phase), "step": 1.0 if phase < 0.5 else -1.0,
              "ramp": 4.0 * abs(phase - 0.5) - 1.0}[kind]  # fmt: skip
        return _scalar(torch.full(x.shape[:1], mean * (STIFF / mean) ** up, dtype=DOUBLE), x)

    return wanted


def at_random(seed=0):
    rng = torch.Generator().manual_seed(seed)
    return lambda step, x, v: random_spd(rng, x.shape[0], n=x.shape[1])  # noqa: ARG005


def _scalar(k, x):
    return k[:, None, None] * torch.eye(x.shape[1], dtype=DOUBLE)


def shaking(step, x, v):  # noqa: ARG001
    """Pushes along the motion for a while, then brakes it, over and over: puts in what it must, takes what it can."""
    direction = torch.where(v.norm(dim=-1, keepdim=True) > 1e-6, v, torch.ones_like(v))
    push = direction / direction.norm(dim=-1, keepdim=True)
    return 4.0 * push if step % 80 < 15 else -1.0 * v


COMMANDS = {
    "knowing": knowing, "stretched": stretched, "random": at_random(),
    **{f"{kind} {ratio}": wave(ratio, kind) for kind in ("sine", "step", "ramp") for ratio in (0.5, 1.0, 2.0)},
}  # fmt: skip


def all_commands(step, x, v):
    """The batch dealt to `COMMANDS`."""
    parts = zip(COMMANDS.values(), x.chunk(len(COMMANDS)), v.chunk(len(COMMANDS)), strict=True)
    return torch.cat([command(step, *part) for command, *part in parts])


@pytest.mark.parametrize("dtype", [DOUBLE, torch.float32])
def test_no_command_lets_more_be_drawn_than_the_store_had_above_its_floor(dtype, rng):
    batch = 4 * len(COMMANDS)
    start = _scalar(torch.full((batch,), SOFT, dtype=DOUBLE), torch.zeros(batch, 3))
    damping = random_spd(rng, batch, n=3, spread=1.0)
    damping = damping * torch.tensor([0.0, 0.001, 0.004, 0.02]).repeat(len(COMMANDS)).reshape(-1, 1, 1)
    mass = random_spd(rng, n=3, spread=0.5) / 100.0
    result = run(all_commands, shaking, start, damping, 400, STORE, mass, dtype=dtype)
    assert (result.level >= STORE.floor).all()
    assert (result.level <= STORE.ceiling).all()
    slack = 1e-9 if dtype == DOUBLE else 1e-4
    assert float(result.drawn.max()) <= STORE.first - STORE.floor + slack
    assert float(torch.linalg.eigvalsh(result.stiffness.double()).min()) > 0.0
    free = run(all_commands, shaking, start, damping, 400, None, mass, dtype=dtype)
    for name, held, loose in zip(COMMANDS, result.share.chunk(12, 1), free.drawn.chunk(12, 1), strict=True):
        assert float(held.min()) < 1.0, name  # every one of them is held back at times,
        if not name.startswith("ramp"):  # and nearly every one would give more away if it were not
            assert float(loose.max()) > STORE.first, name


def test_without_the_filter_the_same_command_gives_energy_without_end():
    start = _scalar(torch.full((1,), SOFT, dtype=DOUBLE), torch.zeros(1, 3))
    free = run(knowing, shaking, start, 0.0 * start, 400, None)
    assert float(free.drawn[-1]) > 10.0 * STORE.first
    held = run(knowing, shaking, start, 0.0 * start, 400, STORE)
    assert 0.1 < float(held.drawn.max()) <= STORE.first - STORE.floor + 1e-9  # and it does get at the store


@pytest.mark.slow
def test_an_optimised_exciter_gets_the_store_and_no_more(rng):
    """Random search that goes on from its best: frequencies, phases and sizes of command and force, and braking."""
    batch = 128
    genes = torch.randn(batch, 8, dtype=DOUBLE, generator=rng)
    start = _scalar(torch.full((batch,), 200.0, dtype=DOUBLE), torch.zeros(batch, 2))
    best = []
    for _ in range(6):
        g = genes

        def wanted(step, x, v, g=g):
            cue = g[:, 0] * (x * v).sum(-1) * 30.0 + g[:, 1] * x.square().sum(-1) * 100.0
            cue = cue + g[:, 2] * torch.sin((20.0 * (1.0 + 0.5 * g[:, 3].tanh())) * DT * step + 3.0 * g[:, 4])
            first = 200.0 * (2.0 * cue.tanh()).exp()
            second = 200.0 * (2.0 * (g[:, 5] * cue).tanh()).exp()
            return torch.diag_embed(torch.stack((first, second), -1))

        def force(step, x, v, g=g):  # noqa: ARG001
            pump = 3.0 * torch.tanh(g[:, 6:7]) * v.sign()
            return torch.where(torch.tensor(step < 15), pump + 0.5, -(g[:, 7:8].exp()) * v)

        result = run(wanted, force, start, 0.05 * start / 200.0, 150, STORE, substeps=4)
        assert float(result.drawn.max()) <= STORE.first - STORE.floor + 1e-9
        assert (result.level >= STORE.floor).all()
        worth = result.drawn.amax(0)
        elite = genes[worth.topk(16).indices]
        best.append(float(worth.max()))
        genes = elite.repeat(batch // 16, 1) + 0.3 * torch.randn(batch, 8, dtype=DOUBLE, generator=rng)
        genes[:16] = elite
    assert best[-1] > 0.25  # most of the 0.4 J that there are to be had
    assert best[-1] >= best[0]


@pytest.mark.slow
@pytest.mark.parametrize("wall", [10.0, 1e3, 1e5, 1e7])
def test_contact_with_springs_from_soft_to_rigid(wall, rng):
    """What a wall has taken is in it, and what went into it came from the store, or from the push that began it."""
    start = _scalar(torch.full((3,), SOFT, dtype=DOUBLE), torch.zeros(3, 3))
    normal = torch.nn.functional.normalize(torch.randn(3, 3, dtype=DOUBLE, generator=rng), dim=-1)
    spring = wall * normal.unsqueeze(-1) * normal.unsqueeze(-2)
    for command in (knowing, at_random(1)):
        result = run(command, shaking, start, 0.002 * start, 300, STORE, wall=spring)
        assert float(result.drawn.max()) <= STORE.first - STORE.floor + 1e-9
        assert (result.level >= STORE.floor).all()


def test_power_is_limited_as_well(rng):
    store = EnergyStore(first=5.0, ceiling=5.0, power=2.0)
    start = _scalar(torch.full((4,), SOFT, dtype=DOUBLE), torch.zeros(4, 2))
    away = 0.1 * torch.randn(4, 2, dtype=DOUBLE, generator=rng)
    result = run(knowing, shaking, start, 0.1 * start, 200, store, at=away)
    assert float(result.injected.max()) <= 2.0 * DT
    assert float(result.injected.max()) > 1.9 * DT
    assert float(result.level.min()) > 0.5  # it was the power that held it back, not the energy


@pytest.mark.slow
def test_what_is_left_of_the_task_when_the_store_is_empty():
    """The target is still held at the stiffness in force; softening passes, and stiffening once the hand is home."""
    empty = EnergyStore(first=0.1, floor=0.1, ceiling=0.6, damping_share=0.0)
    start = _scalar(torch.full((1,), 200.0, dtype=DOUBLE), torch.zeros(1, 2))
    away = torch.tensor([[0.1, -0.05]], dtype=DOUBLE)
    load = torch.tensor([[20.0, 0.0]], dtype=DOUBLE)

    def wanted(step, x, v):
        del x, v
        return start if step < 150 else 4.0 * start

    def loaded(step, x, v):
        del x, v
        return load if step < 300 else 0.0 * load

    stiffer = run(wanted, loaded, start, 0.1 * start, 600, empty)
    # Loaded, the hand stays where the load has it: to lift the load would take energy.
    assert float(stiffer.stiffness[299, 0, 0, 0]) == pytest.approx(200.0, rel=1e-3)
    assert float(stiffer.position[299, 0, 0]) == pytest.approx(0.1, rel=1e-3)
    assert float(stiffer.position[-1].abs().max()) < 1e-6  # let go, it comes home
    refilled = EnergyStore(first=0.1, floor=0.1, ceiling=0.6)
    paid = run(wanted, loaded, start, 0.1 * start, 600, refilled)
    # Damping of the sag had filled the store: it buys a part of the change.
    assert 250.0 < float(paid.stiffness[299, 0, 0, 0]) < 800.0
    assert float(paid.stiffness[-1, 0, 0, 0]) == 800.0  # and the damping of the way home fills it again
    assert float(paid.drawn.max()) <= 1e-9
    softer = run(lambda *_: 0.5 * start, lambda step, x, v: 0.0 * x, start, 0.1 * start, 2, empty, at=away)  # noqa: ARG005
    assert float(softer.stiffness[0, 0, 0, 0]) == 100.0


def test_the_rate_condition_by_hand():
    """Of one joint: a = D / H = 4 /s, so that stiffness may grow by 2 a K = 800 Nm/rad/s."""
    h, d, k = (torch.tensor([[v]], dtype=DOUBLE) for v in (0.5, 2.0, 100.0))
    for rate, margin in ((0.0, 800.0), (799.0, 1.0), (801.0, -1.0), (-1e6, 1e6 + 800.0)):
        assert float(rate_margin(h, d, k, torch.tensor([[rate]], dtype=DOUBLE))) == pytest.approx(margin)
    # Damping that grows by 10 Nms/rad per second costs a D' = 40.
    growing = torch.tensor([[10.0]], dtype=DOUBLE)
    assert float(rate_margin(h, d, k, 0.0 * k, growing)) == pytest.approx(760.0)


def test_the_rate_condition_bounds_what_a_simulation_does(rng):
    """Its storage function never grows along a free motion under it, and growth beyond it can outrun the damping."""
    h, d = random_spd(rng, n=3, spread=0.3) / 100.0, 0.02 * random_spd(rng, n=3, spread=0.3)
    a = torch.linalg.eigvals(torch.linalg.solve(h, d)).real.min()
    k0 = random_spd(rng, n=3)
    for factor, holds in ((1.9, True), (2.1, False)):
        rate = factor * a
        assert bool(rate_margin(h, d, k0, rate * k0) >= 0.0) is holds
    x, v, dt = torch.randn(3, dtype=DOUBLE, generator=rng), torch.zeros(3, dtype=DOUBLE), 1e-4
    stored = []
    for step in range(4000):
        k = k0 * math.exp(1.9 * float(a) * dt * step)
        y = v + a * x
        stored.append(float(0.5 * y @ h @ y + 0.5 * x @ (k + a * d - a * a * h) @ x))
        v = v + dt * torch.linalg.solve(h, -k @ x - d @ v)
        x = x + dt * v
    steps = torch.tensor(stored).diff()
    assert float(steps.max()) < 1e-4 * stored[0]
    assert stored[-1] < stored[0]


def test_derivatives_against_finite_differences(rng):
    a, b = random_spd(rng, 3, spread=0.6), random_spd(rng, 3, spread=0.6)
    e = torch.randn(3, 4, dtype=DOUBLE, generator=rng)
    change = stiffness_energy(a, b, e)
    a, b = torch.where((change > 0)[:, None, None], a, b), torch.where((change > 0)[:, None, None], b, a)
    room = stiffness_energy(a, b, e) * torch.tensor([0.3, 0.7, 2.0], dtype=DOUBLE)  # the last one is free
    inputs = tuple(t.clone().requires_grad_() for t in (a, b, e, room))
    assert torch.autograd.gradcheck(
        lambda a, b, e, r: hold_back(_symmetric(a), _symmetric(b), e, r), inputs, eps=1e-5, atol=1e-4, rtol=1e-4
    )
    assert torch.autograd.gradcheck(lambda a, b, e, _: stiffness_energy(_symmetric(a), _symmetric(b), e), inputs)
    equal = torch.eye(4, dtype=DOUBLE).requires_grad_()  # one ratio of all, as of a PD law that is scaled
    grown = torch.autograd.grad(hold_back(50.0 * equal, 100.0 * equal.detach(), e[0], 1.0).stiffness.sum(), equal)[0]
    assert grown.isfinite().all()


def test_batches_of_any_shape_mapped_compiled_and_under_autocast_are_the_plain_ones(rng):
    a, b = random_spd(rng, 2, 3), random_spd(rng, 2, 3)
    e, room = torch.randn(2, 3, 4, dtype=DOUBLE, generator=rng), torch.full((2, 3), 2.0, dtype=DOUBLE)
    plain = hold_back(a, b, e, room)
    for i in range(2):
        for j in range(3):
            one = hold_back(a[i, j], b[i, j], e[i, j], 2.0)
            for x, y in zip(one, plain, strict=True):
                torch.testing.assert_close(x, y[i, j])
    mapped = torch.vmap(torch.vmap(hold_back))(a, b, e, room)
    compiled = torch.compile(hold_back, fullgraph=True, backend="aot_eager")(a, b, e, room)
    with torch.autocast("cpu", torch.bfloat16):
        inside = hold_back(a, b, e, room)
    with torch.inference_mode():  # without derivatives another way is taken
        fast = hold_back(a, b, e, room)
    assert 0.0 < float(plain.share.min()) < 0.9
    for other in (mapped, compiled, inside, fast):
        for x, y in zip(other, plain, strict=True):
            torch.testing.assert_close(x, y)
    none = hold_back(a[:0], b[:0], e[:0], room[:0])
    assert none.stiffness.shape == (0, 3, 4, 4)
    each = torch.vmap(torch.func.grad(lambda m, e: hold_back(m, 4.0 * m.detach(), e, 1.0).energy))(a[0], e[0])
    assert each.isfinite().all()


K, E = torch.eye(4).expand(5, 4, 4), torch.ones(5, 4)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: hold_back(-K, K, E, 1.0), "k_old must be positive definite, got an eigenvalue of -1"),
        (lambda: hold_back(K, 0.0 * K, E, 1.0), "k_new must be positive definite"),
        (lambda: hold_back(K, K[0], E, 1.0), r"k_new must have the shape of k_old, \(5, 4, 4\), got \(4, 4\)"),
        (lambda: hold_back(K, K.double(), E, 1.0), "k_new must have the dtype and the device of k_old"),
        (lambda: hold_back(K, K, E[:4], 1.0), r"error must have shape \(5, 4\), got \(4, 4\)"),
        (lambda: hold_back(K, K, E * math.nan, 1.0), "error must be finite"),
        (lambda: hold_back(K, K, E, -0.5), "available must not be negative, got -0.5"),
        (lambda: hold_back(K, K, E, torch.ones(4)), r"available must be one number or, as k_old, have shape \(5,\)"),
        (lambda: hold_back(K, K, E, math.inf), "available must be a finite number"),
        (lambda: stiffness_energy((K + 1.0).triu(), K, E), "k_old must be symmetric"),
        (lambda: damping_energy(K, E, 0.0), "dt must be positive, got 0.0"),
        (lambda: damping_energy(K, E[:, :3], 0.02), r"displacement must have shape \(5, 4\), got \(5, 3\)"),
        (lambda: rate_margin(K, -K, K, K), "damping must be positive definite"),
        (lambda: rate_margin(K, K, K, K[:2]), r"stiffness_rate must have the shape of inertia"),
        (lambda: EnergyStore(first=1.0, floor=2.0, ceiling=3.0), "floor <= first <= ceiling must hold, got 2.0, 1.0"),
        (lambda: EnergyStore(power=-1.0), r"power must lie in \[0.0, 1000000000.0\], got -1.0"),
        (lambda: EnergyStore(damping_share=1.5), r"damping_share must lie in \[0.0, 1.0\], got 1.5"),
    ],
)
def test_bad_input_is_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_it_is_exported():
    assert exported is hold_back
