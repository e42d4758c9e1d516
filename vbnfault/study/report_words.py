"""Say in plain words how to read each figure of a study's page, and hold its formulae as MathML."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .summaries import StudyResults


def sample(results: StudyResults, kind: str) -> str:
    """Return in a sentence from how many evaluations the figures of a section come."""
    count, n = len(np.unique(results.column("role"))), int(results.spec["design"]["n"])
    points = results.table.num_rows // (len(np.unique(results.blocks)) * len(results.models))
    nouns = {
        "sobol": f"{n} base samples of {count} points",
        "morris": f"{n} trajectories of {points // n} points",
    }
    noun = nouns.get(results.method, f"{points} points")
    if results.method == "sobol" and kind in ("tornado", "responses"):
        noun = f"{2 * n} points, the matrices A and B of the design"
    views, seeds = len(np.unique(results.column("view"))), len(np.unique(results.column("seed")))
    blocks = f"{views} view{'s' if views > 1 else ''} and {seeds} seed{'s' if seeds > 1 else ''}"
    resamples = results.spec["design"].get("resamples")
    drawn = kind in ("indices", "seeds") and any(
        f"{name}_interval" in results.dataset for name in ("ST", "mu_star", "delta")
    )
    boot = f"; intervals from {resamples} bootstrap resamples" if resamples and drawn else ""
    return f"n: {noun}, with {blocks}{boot}."


@dataclass(frozen=True)
class FigureText:
    """Hold the title of a kind of figure, and a function that returns how to read it, in two sentences."""

    title: str
    how: Callable[[StudyResults], str]


def _ranking(results: StudyResults) -> str:
    level = f"{100 * results.confidence:g} %"
    return (
        f"Each dot is the median of a metric over the views in which a fault acts, with its {level} interval, and "
        "the thin line spans the middle half of these views; the number in brackets counts them. The worst fault "
        "stands on top, the right side is the worse one, and the vertical line is what the clean twin has."
    )


def _overview(results: StudyResults) -> str:
    words = results.importance[0]
    if words == "total index":
        words = "total index, the fraction of the variance that a factor causes alone and with others"
    floor = (
        "The row dummy, a factor that acts on nothing, is exactly 0 in this design."
        if not results.has_noise_floor
        else "Values like those of the row dummy, a factor that acts on nothing, are noise."
    )
    return (
        f"Each cell shows for one factor (row) and one metric (column): {words}. Read a column to see what drives "
        f"a metric. {floor}"
    )


def _indices(results: StudyResults) -> str:
    level = f"{100 * results.confidence:g}\N{NO-BREAK SPACE}%"
    floor = (
        "A factor whose interval overlaps the grey band, the noise floor, cannot be told from the dummy factor, "
        "which acts on nothing."
    )
    if results.has("ST") and not results.has("ST_interval"):
        return (
            "Each dot is an index: the first-order index is the fraction of the variance that a factor causes "
            "alone, and the total index adds its interactions with other factors. A grid gives both exactly for "
            "its levels, so they have no interval."
        )
    if results.has("ST"):
        return (
            f"Each dot is an index with its {level} interval: the first-order index is the fraction of the "
            "variance that a factor causes alone, and the total index adds its interactions with other factors. "
            f"{floor}"
        )
    if results.has("delta"):
        return (
            f"Each dot is an index with its {level} interval: delta says how much knowing the factor changes the "
            "distribution of the metric, from 0 (not at all) to 1, and the first-order index is the fraction of "
            f"the variance that the factor causes alone. {floor}"
        )
    if results.has("S1"):
        return (
            f"Each dot is the first-order index with its {level} interval: the fraction of the variance that the "
            f"factor causes alone. These are too few points for delta. {floor}"
        )
    return (
        f"Each dot is μ*, with its {level} interval: the mean absolute change of the metric when the factor moves "
        "over its whole range. The effects of the dummy factor, which acts on nothing, are exactly 0 in this "
        "design; compare factors by their intervals."
    )


def _seeds(_: StudyResults) -> str:
    return (
        "Each marker is the index from one seed alone, and the bar is the interval from all seeds together. "
        "Markers far outside the bar mean that the index depends on what the seed changes, such as terrain and "
        "noise."
    )


def _tornado(results: StudyResults) -> str:
    if results.method == "one_at_a_time":
        return (
            "Each bar spans the values of the metric along one factor while the others keep their nominal "
            "values, which the vertical line shows. Triangles mark the factor's lowest and highest value; a bar "
            "that goes on beyond them has a turning point."
        )
    floor = ", and a bar no longer than the grey band, the typical range of a factor that acts on nothing, is noise"
    return (
        "Each bar spans the mean of the metric over the levels or the fifths of one factor's range, while the "
        "others vary; the vertical line is the mean of all. Triangles mark the lowest and the highest of them"
        f"{floor if results.shows_chance('tornado') else ''}."
    )


def _responses(results: StudyResults) -> str:
    level = f"{100 * results.confidence:g}\N{NO-BREAK SPACE}%"
    if results.method == "one_at_a_time":
        return (
            "Each curve is the metric against one factor while the others keep their nominal values; bars of a "
            f"factor with categories begin at the median. The band is the {level} interval of the median over "
            "views and seeds."
        )
    floor = (
        " A curve that stays within the noise floor shows nothing that a factor without effect would not show."
        if results.shows_chance("responses")
        else ""
    )
    return (
        f"Each curve is the median of the metric among points of similar value of one factor, with the {level} "
        f"interval of this median; bars of a factor with categories begin at the median of all points.{floor}"
    )


def _interactions(results: StudyResults) -> str:
    if results.has("interaction"):
        return (
            "The diagonal is the first-order index of each factor, and each cell below it the total interaction "
            "of two factors: the fraction of the variance that they cause only together. A dark cell off the "
            "diagonal means that the effect of one factor depends on the other."
        )
    noise = " Small values may be noise, since both indices have intervals." if results.has("ST_interval") else ""
    return (
        "Each cell is the total minus the first-order index of one factor (row) for one metric (column): the "
        f"fraction of the variance that the factor causes only together with others.{noise}"
    )


def _models(_: StudyResults) -> str:
    return (
        "The left bars divide the variance over factors and models into the part between the models, which is "
        "the error of choosing one of them, and the parts that the factors cause within each model. The right "
        "markers show the mean of each model as a multiple of the mean of all models."
    )


def _morris(_: StudyResults) -> str:
    return (
        "Each point is a factor: far right means a strong effect, and high up means an effect that depends on "
        "the other factors or bends. Below the lowest dotted line an effect is almost linear, above the highest "
        "one it is mostly interaction or curvature."
    )


SECTIONS: dict[str, FigureText] = {
    "ranking": FigureText("Cost of each fault", _ranking),
    "overview": FigureText("Which factor drives which metric", _overview),
    "indices": FigureText("Indices with intervals", _indices),
    "morris": FigureText("Strength and bending of effects", _morris),
    "models": FigureText("Model form beside parametric variance", _models),
    "tornado": FigureText("Tornado", _tornado),
    "responses": FigureText("Response curves", _responses),
    "interactions": FigureText("Interactions", _interactions),
    "seeds": FigureText("Spread over seeds", _seeds),
}


# ------------------------------------------------------------------------------------ formulae


def _i(name: str) -> str:
    return f"<mi>{name}</mi>"


def _o(sign: str) -> str:
    return f"<mo>{sign}</mo>"


def _row(*parts: str) -> str:
    return f"<mrow>{''.join(parts)}</mrow>"


def _sub(base: str, index: str) -> str:
    return f"<msub>{base}{index}</msub>"


def _frac(above: str, below: str) -> str:
    return f"<mfrac>{above}{below}</mfrac>"


def _of(name: str, *inner: str) -> str:
    return _row(_i(name), _o("("), *inner, _o(")"))


def _mean(*inner: str) -> str:
    return _row(_o("⟨"), *inner, _o("⟩"))


def _square(*inner: str) -> str:
    return f"<msup>{_row(_o('('), *inner, _o(')'))}<mn>2</mn></msup>"


def _blocks(*inner: str) -> str:
    return _row(_sub(_o("∑"), _i("b")), *inner)


_Y, _X, _M = _i("y"), _sub(_i("x"), _i("i")), _i("m")
_YA, _YB = _sub(_Y, _i("A")), _sub(_Y, _i("B"))
_YAI, _YAJ = _sub(_Y, _row(_i("A"), _i("i"))), _sub(_Y, _row(_i("A"), _i("j")))
_V = _blocks(_sub(_i("V"), _i("b")))
_MODEL_MEAN = _of("E", _Y, _o("|"), _M)
_TOTAL = _row(_of("Var", _Y), _o("="), _sub(_i("E"), _M), _o("["), _of("Var", _Y, _o("|"), _M), _o("]"), _o("+"))

# variables → what they are, in words, and their formula; written where the study has one of the variables
FORMULAE: dict[tuple[str, ...], tuple[str, str]] = {
    ("S1",): (
        "First-order index of factor i: the part of the variance that disappears when the factor is known. A "
        "Sobol' design estimates it after Saltelli et al. (2010), summed over the blocks b (one seed and one "
        "view), with the metric at the base points A and B and at A with factor i from B; a grid evaluates the "
        "definition itself.",
        _row(
            _sub(_i("S"), _i("i")),
            _o("="),
            _frac(_of("Var", _of("E", _Y, _o("|"), _X)), _of("Var", _Y)),
            _o("≈"),
            _frac(_blocks(_mean(_YB, _o("("), _YAI, _o("−"), _YA, _o(")"))), _V),
        ),
    ),
    ("ST",): (
        "Total index of factor i: the part of the variance that remains when all other factors are known "
        "(estimator of Jansen 1999).",
        _row(
            _sub(_i("S"), _row(_i("T"), _i("i"))),
            _o("="),
            _frac(_of("E", _of("Var", _Y, _o("|"), _sub(_i("x"), _row(_o("∼"), _i("i"))))), _of("Var", _Y)),
            _o("≈"),
            _frac(_blocks(_mean(_square(_YA, _o("−"), _YAI))), _row("<mn>2</mn>", _V)),
        ),
    ),
    ("interaction",): (
        "Total interaction of factors i and j: all terms of the variance that contain both (Liu and Owen 2006; "
        "Fruth et al. 2014).",
        _row(
            _sub(_i("S"), _row(_i("i"), _i("j"))),
            _o("≈"),
            _frac(
                _blocks(_mean(_row(_o("("), _YA, _o("−"), _YAI, _o(")"), _o("("), _YA, _o("−"), _YAJ, _o(")")))), _V
            ),
        ),
    ),
    ("explained",): (
        "Control variates (Owen 2013): in each mean above, a term T of the metric is replaced as follows. H is the "
        "same term of a polynomial that is fitted to the other base samples, whose expectation is known exactly "
        "(Sudret 2008), and β is the coefficient of the regression of T on H, from 0 to 1. It is 0 where the "
        "polynomials explain less than half of the variance at samples that they were not fitted to, or where the "
        "metric has heavy tails. Intervals are symmetric bootstrap-t intervals, or percentile intervals where β is "
        "0.",
        _row(_mean(_i("T")), _o("−"), _i("β"), _o("("), _mean(_i("H")), _o("−"), _of("E", _i("H")), _o(")")),
    ),
    ("model_share",): (
        "Law of total variance over the models m, which all count equally: the second term, over the sum, is the "
        "part that the choice of the model causes.",
        _row(_TOTAL, _sub(_i("Var"), _M), _o("["), _MODEL_MEAN, _o("]")),
    ),
    ("mu_star",): (
        "Elementary effect of factor i along a trajectory, and its statistics (Morris 1991; Campolongo et al. "
        "2007).",
        _row(
            _sub(_i("d"), _i("i")),
            _o("="),
            _frac(
                _row(_of("y", _i("x"), _o("+"), _i("Δ"), _sub(_i("e"), _i("i"))), _o("−"), _of("y", _i("x"))),
                _i("Δ"),
            ),
            _o(","),
            _sub(_row(_i("μ"), _o("*")), _i("i")),
            _o("="),
            _mean(_o("|"), _sub(_i("d"), _i("i")), _o("|")),
            _o(","),
            _sub(_i("σ"), _i("i")),
            _o("="),
            _i("std"),
            _o("("),
            _sub(_i("d"), _i("i")),
            _o(")"),
        ),
    ),
    ("delta",): (
        "Delta of factor i: half the mean distance between the density of the metric and its density when the "
        "factor is known (Borgonovo 2007; Plischke et al. 2013).",
        _row(
            _sub(_i("δ"), _i("i")),
            _o("="),
            _frac("<mn>1</mn>", "<mn>2</mn>"),
            _i("E"),
            _o("["),
            _row(_o("∫"), _o("|"), _of("f", _Y), _o("−"), _of("f", _Y, _o("|"), _X), _o("|"), _i("d"), _Y),
            _o("]"),
        ),
    ),
    ("range",): (
        "Range of the metric along factor i with the other factors at their nominal values, the mean over the "
        "blocks.",
        _row(
            _sub(_i("r"), _i("i")),
            _o("="),
            _mean(_sub(_i("max"), _X), _Y, _o("−"), _sub(_i("min"), _X), _Y),
        ),
    ),
}
