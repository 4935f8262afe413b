"""Programs in Fanuc's text form."""

HEAD = """/PROG  TEST
/ATTR
OWNER\t\t= MNEDITOR;
COMMENT\t\t= "größe";
DEFAULT_GROUP\t= 1,*,*,*,*;
/MN
"""


def ls(instructions: str, positions: str) -> str:
    return f"{HEAD}{instructions}/POS\n{positions}/END\n"


def p(number: str, target: str, frames: str = "1, UT : 1", after: str = "") -> str:
    config = "" if target.startswith("@J") else "\t\tCONFIG : 'N U T, 0, 0, 0',"
    return f"P[{number}]{{\n   GP1:\n\tUF : {frames},{config}\n{target}{after}\n}};\n"


GOOD: dict[str, str] = {
    "motions": ls(
        """   1:  UFRAME_NUM=1 ;
   2:  UTOOL_NUM=1 ;
   3:J P[1] 100% FINE    ;
   4:L P[2:corner] 500mm/sec CNT50    ;
   5:C P[3]
    :  P[4] 200mm/sec CNT100    ;
   6:A P[5] 200mm/sec FINE    ;
""",
        p("1", "@J0@") + p('2:"corner"', "@F1:a:c@") + p("3", "@F2:a:c@") + p("4", "@F3:a:c@") + p("5", "@F5:a:c@"),
    ),
    "flange_and_world": ls("   1:L P[1] 100mm/sec FINE ;\n", p("1", "@F0@", "0, UT : 0")),
    "two_tools": ls(
        "   1:L P[1] 100mm/sec FINE ;\n   2:L P[2] 100mm/sec FINE ;\n",
        p("1", "@F0:a:c@") + p("2", "@F1:b:d@", "2, UT : 2"),
    ),
    "loops": ls(
        """   1:  LBL[1] ;
   2:  FOR R[1]=1 TO 3 ;
   3:L P[R[1]] 100mm/sec CNT100 ;
   4:  ENDFOR ;
   5:  IF (DI[1]=ON) THEN ;
   6:J P[2] 50% CNT10 ACC80 ;
   7:  ELSE ;
   8:  JMP LBL[1] ;
   9:  ENDIF ;
  10:  WAIT   .50(sec) ;
  11:  CALL GRIP(1) ;
""",
        p("1", "@F0:a:c@") + p("2", "@F1:a:c@") + p("3", "@F2:a:c@"),
    ),
    "extended_axis": ls("   1:L P[1] 100mm/sec FINE ;\n", p("1", "@F0:a:c@", after=",\n\tE1=   500.000  mm")),
    "second_group": ls(
        "   1:L P[1] 100mm/sec FINE ;\n",
        p("1", "@F0:a:c@", after="\n   GP2:\n\tUF : 0, UT : 1,\n\tJ1=     0.000 deg,\tJ2=    45.000 deg"),
    ),
    "welding": ls(
        """   1:  !Offset,PR[1] in a remark ;
   2:L P[1] 800mm/sec FINE
    :  Arc Start[6]    ;
   3:  Weave Sine[6] ;
   4:L P[2] WELD_SPEED FINE
    :  Arc End[6]    ;
   5:  Weave End ;
   6:  //L P[9] 100mm/sec FINE ;
""",
        p("1", "@F0:a:c@") + p("2", "@F1:a:c@"),
    ),
    "frames_by_registers": ls(
        """   1:  PR[5]=LPOS ;
   2:  PR[5,1]=100 ;
   3:  PR[5,2]=(-20) ;
   4:  PR[5,3]=250.5 ;
   5:  PR[5,4]=0 ;
   6:  PR[5,5]=0 ;
   7:  PR[5,6]=90 ;
   8:  UTOOL[1]=PR[5] ;
   9:L P[1] 100mm/sec FINE ;
""",
        p("1", "@F0:n:c@"),
    ),
    "nested_logic": ls(
        """   1:J P[1] 100% CNT0 ACC100 TB    .10sec,P-SPS    ;
      1:  TC_ONLINE (ON) ;
      2:  DO[23]=OFF ;
       ------ ;
   2:J P[2] 100% CNT100 ACC100 DB    0.0mm,P-SPS    ;
""",
        p("1", "@F0:a:c@") + p("2", "@J3@"),
    ),
    "skip": ls("   1:L P[1] 100mm/sec FINE Skip,LBL[10] ;\n   2:  LBL[10] ;\n", p("1", "@F0:a:c@")),
    "wide_spaces": ls("1: L P[1] 240cm/min CNT100;\n", p("1", "@F2:a:c@").replace("\t", "    ")),
    "crlf": ls("   1:J P[1] 100% FINE ;\n   2:L P[2] 100mm/sec FINE ;\n", p("1", "@J1@") + p("2", "@F2:a:c@")).replace(
        "\n", "\r\n"
    ),
}

REFUSED: dict[str, tuple[str, int, str]] = {
    "offset": (ls("   1:L P[1] 100mm/sec FINE Offset,PR[1] ;\n", p("1", "@F0:a:c@")), 7, "offset"),
    "tool_offset": (ls("   1:L P[1] 100mm/sec FINE Tool_Offset,PR[1] ;\n", p("1", "@F0:a:c@")), 7, "offset"),
    "vision": (ls("   1:L P[1] 100mm/sec FINE VOFFSET,VR[1] ;\n", p("1", "@F0:a:c@")), 7, "offset"),
    "incremental": (ls("   1:L P[1] 100mm/sec FINE INC ;\n", p("1", "@F0:a:c@")), 7, "incremental"),
    "register": (ls("   1:J PR[1:HOME] 100% FINE ;\n", p("1", "@F0:a:c@")), 7, "position register"),
    "coordinated": (ls("   1:L P[1] 100mm/sec FINE COORD ;\n", p("1", "@F0:a:c@")), 7, "coordinated"),
    "assigned": (ls("   1:  P[1]=PR[3] ;\n   2:L P[1] 100mm/sec FINE ;\n", p("1", "@F0:a:c@")), 7, "changed while"),
    "missing": (ls("   1:L P[7] 100mm/sec FINE ;\n", p("1", "@F0:a:c@")), 7, "P[7]"),
    "untaught": (
        ls("   1:L P[1] 100mm/sec FINE ;\n", p("1", "\tX =  ********  mm,\tY =     1.000  mm")),
        12,
        "not taught",
    ),
    "active_frame": (ls("   1:L P[1] 100mm/sec FINE ;\n", p("1", "@F0:a:c@", "F, UT : F")), 7, "active"),
    "computed_tool": (
        ls("   1:  PR[5,1]=R[1] ;\n   2:  UTOOL[1]=PR[5] ;\n   3:L P[1] 100mm/sec FINE ;\n", p("1", "@F0:a:c@")),
        9,
        "register",
    ),
    "far": (
        ls(
            "   1:L P[1] 100mm/sec FINE ;\n",
            p("1", "\tX = 9000. mm,\tY = 1. mm,\tZ = 1. mm,\n\tW = 1. deg,\tP = 1. deg,\tR = 1. deg"),
        ),
        7,
        "reach",
    ),
}
