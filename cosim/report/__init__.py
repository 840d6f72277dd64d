"""Reports of campaigns: figures, and one page that holds everything.

`figures` draws a campaign's result, `page` puts the figures and the numbers into one HTML file
without anything outside it, `report` gathers what both need.
"""
