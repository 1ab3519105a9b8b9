"""Cooperative map matching (CMM): the estimation mathematics, without input or output.

Symbols follow the paper, M. Shen, J. Sun, D. Zhao, "Semi-Interpenetrating Cooperative Localization in Connected
Vehicle Networks": c is the GNSS error that all vehicles share, x_i vehicle i's estimate of it, x̄ their mean.
"""
