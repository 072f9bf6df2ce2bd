"""Ledger: the stored records in benchmarks/results, the tables written from them, and their staleness.

    records      reading of records
    evidence     training runs behind learning figures
    ablations    learning curves of the ablations, one compressed table
    staleness    records that are older than the measured code
    tables/      one file per page or family of tables, as Markdown
    markers      position of a table in its page
    pages        every page with tables from records

    python -m benchmarks.ledger tables     write the tables of README and docs (`make tables`)
    python -m benchmarks.ledger stale      list stale records, rows without a record, and outdated tables (`make stale`)

Neither pyperf nor asv replaces it. pyperf repeats every measurement in fresh worker processes, each of which would compile
its JAX programs again (tens of seconds for a measurement of milliseconds), and its metadata do not include GPUs. asv measures a
range of commits in separate environments; here a GPU is available only once, and the question is which records are older than
the code, without measuring again. Both store seconds, while the tables here show rates, ratios and learning curves. The parts
that they could replace (`jaxrl_vis.bench.timing` and `conditions`, 250 lines) are no longer than the glue code would be.
"""
