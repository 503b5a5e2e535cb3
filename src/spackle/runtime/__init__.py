"""What any program needs: errors, files, folders, digests, device, progress, processes, kernels.

Read `errors.py` first: `InputError` is how every room refuses bad input.
"""
