"""Sign of a controller for plants that begin in the wrong direction."""

import numpy as np

from asia.control.design import Specification, Transfer, design, loop_figures


def test_a_stable_plant_with_inverse_response_gets_a_controller_of_its_final_sign() -> None:
    # (1 - 0.5 s) / (s + 1)^2 begins downward and ends at 1.
    plant = Transfer(np.array([-0.5, 1.0]), np.array([1.0, 2.0, 1.0]))
    wanted = Specification(2.0, 45.0, None, 12.0, 15.0, 1e-3)
    found = design([plant], wanted)
    assert found.controller is not None
    assert found.violated == ()
    assert found.controller.num[-1] > 0
    assert loop_figures(plant, found.controller).stable


def test_an_unstable_plant_keeps_the_sign_of_its_beginning() -> None:
    # 1 / (s - 1): its gain at rest is negative, and a positive controller holds it.
    plant = Transfer(np.array([1.0]), np.array([1.0, -1.0]))
    found = design([plant], Specification(None, 30.0, None, 8.0, 60.0, 1e-2))
    assert found.controller is not None
    assert loop_figures(plant, found.controller).stable
