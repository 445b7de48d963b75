"""Camera files: their tags, one module per maker, and the captures below a folder.

In: folders of images. Out: captures with typed tags (`FolderScan`), and problems of files.
"""
