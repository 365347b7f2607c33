from __future__ import annotations

import numpy as np
import pytest
import torch

from extrags.errors import ConfigError, ShapeError
from extrags.raster import SelectiveAdam, native, set_num_threads

RATES = {"means": 1e-3, "opacities": 5e-2, "sh": 2e-3}


def _parameters(n: int = 60, dtype: torch.dtype = torch.float32) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    shapes = {"means": (n, 3), "opacities": (n,), "sh": (n, 16, 3)}
    return {k: torch.randn(*s, generator=generator).to(dtype).requires_grad_() for k, s in shapes.items()}


def _set_gradients(parameters: dict[str, torch.Tensor], step: int) -> None:
    generator = torch.Generator().manual_seed(100 + step)
    for value in parameters.values():
        value.grad = torch.randn(value.shape, generator=generator).to(value.dtype)


def _visible(n: int, step: int) -> torch.Tensor:
    return torch.rand(n, generator=torch.Generator().manual_seed(200 + step)) > 0.4


def test_equals_adam_of_torch(isa: str) -> None:
    ours, theirs = _parameters(), _parameters()
    adam = SelectiveAdam(ours, RATES)
    groups = [{"params": [theirs[k]], "lr": rate} for k, rate in RATES.items()]
    expected = torch.optim.Adam(groups, eps=1e-15)
    for step in range(30):
        _set_gradients(ours, step)
        _set_gradients(theirs, step)
        adam.step()
        expected.step()
    for name, value in ours.items():
        torch.testing.assert_close(value, theirs[name], rtol=1e-5, atol=1e-6)


def test_native_equals_torch_path_for_visible_rows(isa: str) -> None:
    ours, wide = _parameters(), _parameters(dtype=torch.float64)
    adam, reference = SelectiveAdam(ours, RATES), SelectiveAdam(wide, RATES)
    for step in range(25):
        _set_gradients(ours, step)
        _set_gradients(wide, step)
        visible = _visible(60, step)
        adam.step(visible)
        reference.step(visible)
    for name, value in ours.items():
        torch.testing.assert_close(value.double(), wide[name], rtol=1e-5, atol=1e-6)


def test_invisible_rows_are_left_alone() -> None:
    parameters = _parameters()
    before = {k: v.detach().clone() for k, v in parameters.items()}
    adam = SelectiveAdam(parameters, RATES)
    visible = _visible(60, 0)
    _set_gradients(parameters, 0)
    adam.step(visible)
    for name, value in parameters.items():
        assert torch.equal(value.detach()[~visible], before[name][~visible])
        assert bool((value.detach()[visible] != before[name][visible]).all())
    assert torch.equal(adam.steps > 0, visible)


def test_a_row_seen_late_starts_like_the_first_step() -> None:
    """A first Adam step is the learning rate, whatever the gradient's size."""
    parameters = {"means": torch.zeros(2, 3, requires_grad=True)}
    adam = SelectiveAdam(parameters, {"means": 0.01})
    for _ in range(50):
        parameters["means"].grad = torch.ones(2, 3)
        adam.step(torch.tensor([True, False]))
    parameters["means"].grad = torch.full((2, 3), 7.0)
    adam.step(torch.tensor([False, True]))
    torch.testing.assert_close(parameters["means"].detach()[1], torch.full((3,), -0.01))


def test_keep_and_append() -> None:
    parameters = _parameters(10)
    adam = SelectiveAdam(parameters, RATES)
    _set_gradients(parameters, 0)
    adam.step()
    first = adam.first_moments["sh"].clone()
    mask = torch.arange(10) % 2 == 0
    adam.keep(mask)
    assert torch.equal(adam.first_moments["sh"], first[mask])
    new_gaussians = {k: torch.full((3, *v.shape[1:]), 0.5) for k, v in adam.parameters.items()}
    adam.append(new_gaussians)
    assert adam.steps.tolist() == [1] * 5 + [0] * 3
    for name, value in adam.parameters.items():
        assert value.is_leaf
        assert value.requires_grad
        assert len(value) == 8
        assert float(adam.first_moments[name][5:].abs().max()) == 0
    _set_gradients(adam.parameters, 1)
    adam.step()
    moved = (adam.parameters["means"].detach()[5:] - 0.5).abs()
    torch.testing.assert_close(moved, torch.full((3, 3), RATES["means"]), rtol=1e-3, atol=0)


def test_rate_zero_and_missing_gradient_leave_a_parameter() -> None:
    parameters = _parameters(5)
    before = {k: v.detach().clone() for k, v in parameters.items()}
    adam = SelectiveAdam(parameters, {**RATES, "means": 0.0})
    _set_gradients(parameters, 0)
    parameters["sh"].grad = None
    adam.step()
    assert torch.equal(parameters["means"], before["means"])
    assert torch.equal(parameters["sh"], before["sh"])
    assert not torch.equal(parameters["opacities"], before["opacities"])
    adam.zero_grad()
    assert all(value.grad is None for value in parameters.values())


def test_more_steps_than_the_table_of_bias_corrections() -> None:
    parameters = {"means": torch.zeros(1, 3, requires_grad=True)}
    adam = SelectiveAdam(parameters, {"means": 1e-3})
    for _ in range(1100):
        parameters["means"].grad = torch.ones(1, 3)
        adam.step()
    torch.testing.assert_close(parameters["means"].detach(), torch.full((1, 3), -1.1), rtol=1e-4, atol=0)


def test_same_bits_on_any_number_of_threads(isa: str, threads: None) -> None:
    results = []
    for count in (1, 2, 3):
        set_num_threads(count)
        parameters = _parameters(5000)
        adam = SelectiveAdam(parameters, RATES)
        for step in range(3):
            _set_gradients(parameters, step)
            adam.step(_visible(5000, step))
        results.append([v.detach().clone() for v in parameters.values()])
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_huge_gradients_do_not_poison_the_state(isa: str) -> None:
    parameters = {"means": torch.zeros(4, 3, requires_grad=True)}
    adam = SelectiveAdam(parameters, {"means": 1e-3})
    for size in (3e38, 1e30, 1e-30, 0.0):
        parameters["means"].grad = torch.full((4, 3), size)
        adam.step()
        assert bool(parameters["means"].isfinite().all())
        assert bool(adam.second_moments["means"].isfinite().all())


def test_huge_gradients_move_no_further_than_large_ones(isa: str) -> None:
    moved = []
    for size in (1e18, 1e20, 3e38, float("inf")):
        for dtype in (torch.float32, torch.float64):
            adam = SelectiveAdam({"means": torch.zeros(6, 3, dtype=dtype)}, {"means": 1e-3})
            adam.step(gradients={"means": torch.full((6, 3), size, dtype=dtype)})
            moved.append(adam.parameters["means"].float())
    for other in moved:
        torch.testing.assert_close(other, torch.full((6, 3), -1e-3), rtol=1e-5, atol=0)


def test_a_gradient_that_is_not_a_number_stays_visible(isa: str) -> None:
    for dtype in (torch.float32, torch.float64):
        adam = SelectiveAdam({"means": torch.zeros(6, 3, dtype=dtype)}, {"means": 1e-3})
        gradient = torch.ones(6, 3, dtype=dtype)
        gradient[4, 1] = float("nan")
        adam.step(gradients={"means": gradient})
        assert torch.equal(adam.parameters["means"].isnan(), gradient.isnan())


@pytest.mark.parametrize("wrong", [(3, 4), (4, 1), (3,), (12,)])
def test_gradients_have_the_shape_of_their_parameter(wrong: tuple[int, ...], unchecked: None) -> None:
    adam = SelectiveAdam({"means": torch.zeros(4, 3)}, {"means": 0.1})
    with pytest.raises(ShapeError, match=r"gradient of means has shape .*, expected \(4, 3\)"):
        adam.step(gradients={"means": torch.ones(wrong)})
    assert int(adam.steps.sum()) == 0


def test_gradients_of_joined_parameters_have_the_shape_of_the_whole(unchecked: None) -> None:
    adam = SelectiveAdam(_split_parameters(6, 4), JOINED_RATES, joined=JOINED)
    with pytest.raises(ShapeError, match=r"gradient of sh has shape \(6, 3, 4\), expected \(6, 4, 3\)"):
        adam.step(gradients={"sh": torch.ones(6, 3, 4)})


@pytest.mark.parametrize("wrong", ["strides", "dtype", "read-only"])
@pytest.mark.parametrize("place", [0, 2, 3])
def test_the_kernel_refuses_arrays_it_could_change_a_copy_of_only(place: int, wrong: str) -> None:
    arrays = [np.zeros((8, 3), dtype=np.float32) for _ in range(4)]
    if wrong == "strides":
        arrays[place] = np.zeros((8, 6), dtype=np.float32)[:, :3]
    elif wrong == "dtype":
        arrays[place] = np.zeros((8, 3))
    else:
        arrays[place].flags.writeable = False
    bias = np.ones(10, dtype=np.float32)
    with pytest.raises(ValueError, match="must be float32, contiguous and writable"):
        native.compiled_kernels().adam(
            [(*arrays, 0.1)], np.ones(8, dtype=np.int32), bias, bias, None, 0.9, 0.999, 1e-8
        )


def test_one_row_of_joined_parameters_is_stepped() -> None:
    """Slices of one row are contiguous, whatever strides they have."""
    adam = SelectiveAdam(_split_parameters(1, 4), JOINED_RATES, joined=JOINED)
    before = adam.joined["sh"].values.clone()
    _set_gradients(adam.parameters, 0)
    adam.step()
    assert bool((adam.joined["sh"].values != before).all())


def test_errors(unchecked: None) -> None:
    parameters = _parameters(5)
    with pytest.raises(ConfigError, match="no learning rate for sh"):
        SelectiveAdam(parameters, {"means": 1.0, "opacities": 1.0})
    with pytest.raises(ShapeError, match="number of rows"):
        SelectiveAdam({**parameters, "means": torch.zeros(4, 3)}, RATES)
    adam = SelectiveAdam(parameters, RATES)
    with pytest.raises(ShapeError, match=r"visible is torch.bool \(4,\), expected torch.bool \(5,\)"):
        adam.step(torch.ones(4, dtype=torch.bool))
    with pytest.raises(ShapeError, match=r"visible is torch.uint8 \(5,\)"):
        adam.step(torch.ones(5, dtype=torch.uint8))
    with pytest.raises(ShapeError, match="mask has shape"):
        adam.keep(torch.ones(4, dtype=torch.bool))
    with pytest.raises(ShapeError, match="rows of"):
        adam.append({"means": torch.zeros(1, 3)})
    bad = {k: torch.zeros(1, *v.shape[1:]) for k, v in parameters.items()}
    with pytest.raises(ShapeError, match="differ in their number"):
        adam.append({**bad, "means": torch.zeros(2, 3)})
    with pytest.raises(ShapeError, match="rows of sh"):
        adam.append({**bad, "sh": torch.zeros(1, 4, 3)})


JOINED = {"sh": ("sh0", "shN")}
JOINED_RATES = {"means": 1e-3, "sh0": 2e-3, "shN": 1e-4}


def _split_parameters(n: int, coefficients: int) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(9)
    shapes = {"means": (n, 3), "sh0": (n, 1, 3), "shN": (n, coefficients - 1, 3)}
    return {k: torch.randn(*s, generator=generator).requires_grad_() for k, s in shapes.items()}


@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
def test_joined_parameters_step_as_if_apart(coefficients: int, isa: str) -> None:
    apart = SelectiveAdam(_split_parameters(70, coefficients), JOINED_RATES)
    together = SelectiveAdam(_split_parameters(70, coefficients), JOINED_RATES, joined=JOINED)
    new_gaussians = {k: v.detach()[:5].clone() for k, v in apart.parameters.items()}
    for step in range(12):
        n = len(apart.steps)
        _set_gradients(apart.parameters, step)
        gradients = {name: value.grad for name, value in apart.parameters.items() if value.grad is not None}
        whole = torch.cat([gradients["sh0"], gradients["shN"]], dim=1)
        visible = _visible(n, step)
        apart.step(visible)
        together.step(visible, {"means": gradients["means"], "sh": whole})
        if step in (3, 7):
            for adam in (apart, together):
                adam.keep(torch.arange(n) % 3 != 0)
                adam.append(new_gaussians)
        if step == 5:
            for adam in (apart, together):
                with torch.no_grad():
                    adam.parameters["shN"][2] = 0.5
                adam.first_moments["sh0"][2] = 0
    for name, value in apart.parameters.items():
        assert torch.equal(together.parameters[name], value), name
        assert torch.equal(together.first_moments[name], apart.first_moments[name]), name
        assert together.parameters[name].is_leaf
        assert together.parameters[name].requires_grad
    whole = torch.cat([apart.parameters["sh0"], apart.parameters["shN"]], dim=1)
    assert torch.equal(together.joined["sh"].values, whole)


def test_joined_parameters_take_gradients_of_their_own() -> None:
    """As autograd leaves them: what a penalty or a test may do."""
    apart = SelectiveAdam(_split_parameters(20, 4), JOINED_RATES)
    together = SelectiveAdam(_split_parameters(20, 4), JOINED_RATES, joined=JOINED)
    for adam in (apart, together):
        _set_gradients(adam.parameters, 0)
        adam.step(_visible(20, 0))
    for name, value in apart.parameters.items():
        torch.testing.assert_close(together.parameters[name], value, rtol=1e-6, atol=1e-7)
