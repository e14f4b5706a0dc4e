"""Scores of result files by the public protocols of BrnoCompSpeed and Luvizon, and reports of them."""
