"""Aligners of others, to compare with: each in a file of its own, all trained on our samples."""

ALIGNERS = {
    "reldist": "iga_drake.aligners.peers.reldist:RelDistAligner",
    "taxpose": "iga_drake.aligners.peers.taxpose:TaxPoseAligner",
    "rndf": "iga_drake.aligners.peers.rndf:RndfAligner",
}
