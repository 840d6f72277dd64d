"""The statistics of a campaign, each one class: from the histories of members to the verdict."""
