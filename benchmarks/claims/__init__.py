"""Tables and claims of the documentation, computed from the stored learning records.

    records      stored runs, by the names that tables use
    columns      statistics of a record as cells of a table
    ol_aux       tables of the study of auxiliary losses (figures 5.4 to 5.7)
    indicator    tables of the study of rewards without ground truth (figures 5.1, 5.2, estimators, cameras)
    ablations    tables of runs with a few options changed
    weightings   tables of figure weightings
    goals        tables of figure goals
    contrastive_view  table of the task of contrastive RL
    thesis       claims of the thesis compared with the records, for docs/claims.md and, abridged, the README
    prose        comparison of sentences that quote numbers with their pages
    sentences    these sentences, with computed numbers; ol_aux_sentences has those of the study of auxiliary losses,
                 comparison_sentences those of figures goals and weightings
    pages        all tables, by page and marker
    markdown     rows of records as a table in Markdown

`make tables` writes the tables (`benchmarks.ledger.pages`), `python benchmarks/check_claims.py` checks them and the sentences.
"""
