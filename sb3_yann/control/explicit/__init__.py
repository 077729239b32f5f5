"""The multi-parametric QP solved off line, with a certificate."""
