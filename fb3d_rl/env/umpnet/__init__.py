"""UMPNet's world (Xu, He and Song, RA-L 2022): its scenes and its pull, simulated by PyBullet or quasi-statically."""
