from asia.problem import Bounds, ParameterRange, Physics
from asia.problem.physics import FUNCTIONS
from asia.report.drawing.style import drawing
from asia.report.pictures.equations import draw_equations, typeset


def test_terms_stay_in_the_order_the_person_wrote() -> None:
    assert typeset("-k1*sqrt(x1) + k4*u") == r"- k_{1}\,\sqrt{x_{1}} + k_{4}\,u"
    assert typeset("2*x/(1 + a_b)") == r"\frac{2\,x}{1 + a_{b}}"
    assert typeset("tau_h*tau_heater") == r"\tau_{h}\,\mathrm{tau\_heater}"
    assert typeset("pump_voltage*omega") == r"\mathrm{pump\_voltage}\,\omega"


def test_names_that_mean_something_to_sympy_are_only_names() -> None:
    assert typeset("N + S + Q + beta*I") == r"N + S + Q + \beta\,I"


def test_every_function_of_the_table_is_drawn() -> None:
    arguments = {name: ", ".join(["x"] * least) for name, (least, _) in FUNCTIONS.items()}
    dynamics = {f"x{i}": f"{name}({arguments[name]})" for i, name in enumerate(FUNCTIONS)}
    physics = Physics(
        states=tuple(dynamics),
        dynamics=dynamics,
        parameters={"x": ParameterRange(0.1, 1.0)},
        bounds={"x0": Bounds(0.0, None)},
    )
    with drawing():
        figure = draw_equations(physics)
        figure.draw_without_rendering()
    assert len(figure.texts) == 1 + 2 * (len(FUNCTIONS) + 1)
