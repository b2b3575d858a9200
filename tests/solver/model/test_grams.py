"""Sums over motions, against NumPy with each product of component and function a column of its own."""

import numpy as np
import pytest
import torch

from rmis_calib.solver.model.grams import gram, gram_of_products


def written_out(white: np.ndarray, part: slice, functions: np.ndarray) -> np.ndarray:
    """Columns (k, p, b, n) with every component in the place of its products, neighbours together."""
    products = white[:, part, None] * functions[None, None]  # (k, c, f, b, n)
    return np.concatenate(
        (white[:, : part.start], products.reshape(len(white), -1, *white.shape[2:]), white[:, part.stop :]), axis=1
    )


@pytest.mark.parametrize("part", [slice(2, 5), slice(0, 1), slice(4, 6)])
@pytest.mark.parametrize("grouped", [True, False])
def test_products_of_components_and_functions(part: slice, grouped: bool) -> None:
    rng = np.random.default_rng(7)
    white, functions = rng.standard_normal((4, 7, 2, 9)), rng.standard_normal((3, 2, 9))
    member = rng.uniform(size=(2, 9, 2)) if grouped else np.ones((2, 9, 1))
    columns = written_out(white, part, functions)
    expected = np.einsum("kpbn,kqbn,bng->bgpq", columns, columns, member)
    given = torch.from_numpy(member) if grouped else None
    found = gram_of_products(torch.from_numpy(white), given, part, torch.from_numpy(functions))
    np.testing.assert_allclose(found.numpy(), expected, rtol=0, atol=1e-12)


def test_groups_of_plain_columns() -> None:
    rng = np.random.default_rng(8)
    white, member = rng.standard_normal((4, 5, 2, 9)), rng.uniform(size=(2, 9, 3))
    expected = np.einsum("kpbn,kqbn,bng->bgpq", white, white, member)
    found = gram(torch.from_numpy(white), torch.from_numpy(member))
    np.testing.assert_allclose(found.numpy(), expected, rtol=0, atol=1e-12)
