"""The declarations of the cooperative positioning programs; docs/how-to/own-figures.md describes such a module."""

CHECKS = (
    "agents.cooperative.checks:check_consensus_mean",
    "agents.cooperative.checks:check_convergence",
    "agents.cooperative.checks:check_bounded_error",
)
REFERENCE = "agents.cooperative.hears_all:HearsAll"
PUBLISHED = "agents.cooperative.paper_values:paper_rmse"
FIGURES = "agents.cooperative.figures:Figures"
