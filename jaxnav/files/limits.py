"""Caps on what a file may declare or unpack to, and where each comes from.

No file of 50 MB may take more than 2 GiB or 10 s to be read or refused. So every reader checks
these caps before it allocates what a file declares, and counts what it unpacks. Honest recordings
need a tenth of a cap or less; docs/files.md says which were tried.
"""

MIB = 2**20

# Text. A map has 4096 markers at most, 25 values and 200 bytes each; a value of YAML costs 15 us.
YAML_BYTES = 2 * MIB
YAML_VALUES = 300_000
DEPTH = 24  # our deepest file has 7 levels
# PhotonVision keeps its snapshots inside, as base64; the rest is some thousand values.
JSON_BYTES = 64 * MIB
JSON_VALUES = 2_000_000  # 100 bytes and 1 us each

# Pictures. On noise, the search for markers takes up to 43 bytes a pixel: 1.5 GiB. Cameras that
# drive have 0.3 to 8 million pixels, one for photographs 12 to 30.
IMAGE_PIXELS = 2**25
IMAGE_BYTES = 256 * MIB  # of an image with so many pixels, not compressed, 16 bits in 4 channels

# Arrays once they are unpacked, all of a file: 3 million detections, two days of a rig of four.
NPZ_BYTES = 256 * MIB

# Recordings. Compression makes them 3 to 10 times smaller (TagSLAM's bags in bz2: 1.04 to 9.5; ours
# in zstd: 9). A file may unpack to UNPACKED_TIMES its size, and to UNPACKED_BYTES on top of that.
UNPACKED_BYTES = 64 * MIB
UNPACKED_TIMES = 32
CHUNK_BYTES = 64 * MIB  # one of a bag or an MCAP file: 0.8 to 4 MiB, or a single large image
MESSAGE_BYTES = 4 * MIB  # of a message that is no picture: one of 4096 markers in view has 1 MiB
CONNECTIONS = 4096  # of a bag: one a topic and publisher
INDEX_ENTRIES = 2_000_000  # of a bag, 200 bytes each: half an hour of 1 kHz
DEFINITION_BYTES = 64 * 2**10  # of a type of message; PX4's longest have 10
LIST_LENGTH = 1000  # of messages in one that a definition declares; covariances are plain numbers
SQLITE_STEPS = 400_000_000  # to open a .db3: 30 each message, 30 ns each step
# Of our own recordings, with their outcomes: an hour at 130 inputs a second. 1.7 kB of memory each.
MCAP_MESSAGES = 1_000_000
# Of a recording that is read as a whole: two hours of a rig that has 8 markers in view at 30 Hz.
DETECTIONS = 2_000_000
IN_VIEW = 4096  # markers in one frame of a camera: all of the largest map
TRACKED_POSES = 4_000_000  # frames x markers where each marker is tracked alone, 90 bytes each

# A study's store, as much as is read at once: a box has 2 million trials at most, 8 bytes each.
STORE_BYTES = 128 * MIB
