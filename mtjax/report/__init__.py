"""Reports on runs: statistics over seeds, tables, figures and films."""

from mtjax.names import lazily

_FIGURES = (
    *("families", "improvement", "iqm", "learning_curves", "performance_profile", "posterior", "return_by_parameter"),
    "save",
)
__getattr__, __dir__ = lazily(__name__, {name: "mtjax.report.plots" for name in _FIGURES})
__all__ = [*_FIGURES]
