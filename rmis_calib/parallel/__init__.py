"""Many tasks side by side, on processes of this machine or on a dask cluster, and who works on an output folder."""
