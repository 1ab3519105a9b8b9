"""The key figures of a run: the means in `verdict.json` that summaries, reports and comparisons show."""

KEY_FIGURES = {
    "common_error_rmse_m": "common error, RMSE",
    "deviation_m": "deviation between vehicles",
    "position_rmse_m": "position, RMSE of the estimates",
    "fix_rmse_m": "position, RMSE of the raw fixes",
    "consensus_error_m": "consensus error",
}
"""Titles by name; all are in metres, and means after the first fifth of the run."""
