"""Studies: tables whose cells are resumable jobs on processes of this machine or a Dask cluster."""
