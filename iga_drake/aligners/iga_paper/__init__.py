"""The paper's aligner and its variants, on a graph of the objects' nodes."""

ALIGNERS = {
    "iga-paper": "iga_drake.aligners.iga_paper.aligner:IgaPaperAligner",
    "dirreg": "iga_drake.aligners.iga_paper.variants:DirRegAligner",
    "dfm": "iga_drake.aligners.iga_paper.variants:DfmAligner",
}
