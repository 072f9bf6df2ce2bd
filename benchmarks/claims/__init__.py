"""Tables and claims of the documentation, computed from the kept records of learning.

    records      kept runs, by the names that tables use
    columns      statistics of a record as cells of a table
    ol_aux       tables of the study of auxiliary losses (figures 5.4 to 5.7)
    indicator    tables of the study of rewards without ground truth (figures 5.1, 5.2, estimators, cameras)
    ablations    tables of single runs with one option changed
    thesis       claims of the thesis beside the records, for docs/claims.md and in short for README and index
    prose        sentences that quote numbers, compared with their pages
    sentences    these sentences, computed
    pages        all tables of all pages
    writer       pages and their markers

`python -m benchmarks.claims` writes the tables, `python benchmarks/check_claims.py` checks them and the sentences.
"""
