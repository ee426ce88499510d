"""`jaxnav calibrate board`: a calibration target to print at true scale."""

from datetime import UTC, datetime
from pathlib import Path

from jaxnav import __version__
from jaxnav.calibrate.board.board import Board
from jaxnav.calibrate.board.sheets import PAPERS_MM, check_fit, largest, sheet_of
from jaxnav.commands.calibrate.arguments import CalibrateBoard
from jaxnav.commands.process import configure_jax
from jaxnav.core.models.markers import FAMILY_SIZES
from jaxnav.detection import marker_cells
from jaxnav.errors import BadInput
from jaxnav.files import atomic_path, boards, output_folder, write_json
from jaxnav.pictures.board import board_page

# Longer and shorter side, in squares or tags.
_GRIDS = {"charuco": (9, 6), "aprilgrid": (6, 4), "chessboard": (10, 7), "marker": (1, 1)}
_ADVICE = (
    "Print at 100 %: no scaling to the page, no borderless mode.",
    "Measure both rulers. Where one is off, write the measured size into board.yaml; where the two "
    "differ, use another printer.",
    "Glue the print to something flat and stiff: a millimetre of bend is seen.",
)


def run(args: CalibrateBoard) -> int:
    """Write the board as PDF, PNG and YAML, and a report that says how to check the print."""
    configure_jax(float64=True)
    width_mm, height_mm = args.paper_size_mm or PAPERS_MM[args.paper.lower()]
    turned = args.landscape and width_mm <= height_mm
    paper_mm = (height_mm, width_mm) if turned else (width_mm, height_mm)
    board = _board(args, paper_mm)
    folder = output_folder(args.out)
    words = str(board)
    figure = board_page(sheet_of(board), words, paper_mm)
    # Without a date the same board is the same file.
    for form, metadata in (("pdf", {"CreationDate": None}), ("png", None)):
        with atomic_path(folder / f"board.{form}") as beside:
            figure.savefig(beside, dpi=args.dpi, format=form, metadata=metadata)
    boards.save_board(folder / "board.yaml", vars(board))
    write_json(
        folder / "report.json",
        {
            "date": datetime.now(UTC).date().isoformat(),
            "tool": f"jaxnav {__version__} calibrate board",
            "board": words,
            "points": len(board.points_board_m),
            "ink_mm": [1e3 * board.width_m, 1e3 * board.height_m],
            "paper_mm": paper_mm,
            "dpi": args.dpi,
            "advice": _ADVICE,
        },
    )
    print(f"{words}, on {paper_mm[0]:g} x {paper_mm[1]:g} mm")
    print(f"{folder / 'board.pdf'}, {folder / 'board.png'}, {folder / 'board.yaml'}")
    print("\n".join(_ADVICE))
    family = "" if board.family == "tag36h11" else f" --family {board.family}"
    print(
        "Photograph it with a calibrated camera: jaxnav locate PHOTO --camera camera.yaml "
        f"--marker-size-m {board.size_m:g}{family}, the side as measured where a ruler is off"
        if board.kind == "marker"
        else "Photograph it 20 times, tilted, into the corners of the image: "
        f"jaxnav calibrate intrinsics FOLDER --board {folder / 'board.yaml'}"
    )
    return 0


def _board(args: CalibrateBoard, paper_mm: tuple[float, float]) -> Board:
    long, short = _GRIDS[args.target]
    across, down = (long, short) if paper_mm[0] > paper_mm[1] else (short, long)
    columns, rows = args.columns or across, args.rows or down
    family = _family(args, columns * rows // 2)
    # Without a given size, squares of 1 m, which are scaled below.
    size_m, marker_m = args.size_m or 1.0, args.marker_size_m or 0.0
    if args.target == "charuco" and args.marker_size_m is None:
        cells = len(marker_cells(family, 0))
        marker_m = size_m * cells / (cells + 2)
    try:
        board = Board(
            args.target,
            columns,
            rows,
            size_m,
            marker_m=marker_m,
            spacing=args.spacing if args.target == "aprilgrid" else 0.0,
            family=family,
            first_id=0 if args.target == "chessboard" else args.first_id,
            border_cells=args.border_cells if args.target == "aprilgrid" else 1,
        )
        if args.size_m is None:
            board = largest(board, paper_mm)
        check_fit(board, paper_mm)
    except ValueError as error:
        raise BadInput(args.target, str(error)) from None
    return board


def _family(args: CalibrateBoard, charuco_markers: int) -> str:
    if args.target == "chessboard":
        return ""
    if args.family is not None:
        if args.family not in FAMILY_SIZES:
            raise BadInput("--family", f"must be one of {', '.join(FAMILY_SIZES)}")
        return args.family
    if args.target != "charuco":
        return "tag36h11"
    needed = args.first_id + charuco_markers
    return next((f"4x4_{n}" for n in (50, 100, 250, 1000) if n >= needed), "4x4_1000")


def read_board(path: Path) -> Board:
    """Read the board of a file.

    Raises:
        BadInput: one line naming file and key.
    """
    entry = boards.load_board(path)
    try:
        return Board(**entry.figures())
    except ValueError as error:
        raise BadInput(path, str(error)) from None
