"""Physical terms that a model may lack, and the tests that find them."""

from mjfim.identification.terms.score_tests import TermTests, find_missing_terms

__all__ = ["TermTests", "find_missing_terms"]
