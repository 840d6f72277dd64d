"""Campaigns: many members of one system, flown in batches, with the statistics that follow.

The layers, each of which knows only those above it: `statistics` (blocks of 64 members, merged in
order), `verdict` (what the statistics say), `batch` (members to blocks), `store` (blocks in a
folder), `pools` (where batches are flown), `campaign` (all of it), `report` and `figures`.
"""
