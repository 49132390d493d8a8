"""Learned dense correspondence, consistency voting and a learned energy."""

ALIGNERS = {
    "iga": "iga_drake.aligners.iga.aligner:IgaAligner",
    "iga-energy": "iga_drake.aligners.iga.aligner:make_iga_energy",
}
