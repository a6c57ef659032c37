"""Mutation testing of the numeric modules: small faults planted by a printed seed, and which of them the tests find.

`make mutants SEED=1 COUNT=300` draws places in the code, changes each in one way, and runs the tests that cover its
lines, the quickest first, until one fails. docs/mutants.md has the figures, and a sentence for each survivor.

Tools of others were looked at. mutmut leaves out every function with a decorator, which here are the compiled loops,
the properties and the cached tables; cosmic-ray starts a process for each mutant, which spends more on imports than
most tests take. Neither draws by a seed.
"""
