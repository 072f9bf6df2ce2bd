"""Tables of the README and docs, written from the records as Markdown.

comparison   README and docs/index.md        platforms    docs/where_it_ran.md
lab_results  docs/lab/results.md             scaling      docs/scaling.md
lab_rows     rows of lab_results             stalks       docs/phenotyping.md
render       docs/lab/renderer_speed.md      weighting    docs/weighting.md
contrastive  docs/algorithms.md              exported     docs/export.md
pixels       docs/pixels.md                  host         docs/indicator_rewards.md
push         docs/tasks.md               audit        docs/indicator_rewards.md
factors      docs/lab/real_stalks.md
render also writes docs/lab/meshes.md.
"""
