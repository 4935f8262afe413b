"""Programs in KRL: text, data file, and what the tool and base numbers stand for."""

GOOD: dict[str, tuple[str, str]] = {
    "frames_in_place": (
        """DEF frames_in_place()
; Schweißprogramm, größe 10
BAS(#INITMOV, 0)
$TOOL = {@T:a@}
$BASE = {@B:c@}
PTP {E6POS: @F0:a:c@, @S0@}
LIN {@F1:a:c@} C_DIS
LIN {POS: @F2:a:c@, @S2@}   ; P1.Z = 10
PTP {E6AXIS: @J3@}
END
""",
        "",
    ),
    "names_in_data": (
        """&ACCESS RVP
&REL 12
&PARAM EDITMASK = *
DEF names_in_data ( )
;FOLD INI
  GLOBAL INTERRUPT DECL 3 WHEN $STOPMESS==TRUE DO IR_STOPM ( )
  INTERRUPT ON 3
  BAS (#INITMOV,0 )
;ENDFOLD (INI)
;FOLD PTP P1 CONT Vel=100 % PDAT1 Tool[1]:grip Base[2]:table;%{PE}%R 8.3.48,%MKUKATPBASIS,%CMOVE,%VPTP
$BWDSTART=FALSE
PDAT_ACT=PPDAT1
FDAT_ACT=FP1
BAS(#PTP_PARAMS,100)
PTP XP1 C_PTP
;ENDFOLD
;FOLD LIN P2 Vel=2 m/s
FDAT_ACT=FP2
BAS(#CP_PARAMS,2)
LIN XP2
;ENDFOLD
CIRC XP3, XP4
PTP XHOME
END
""",
        """&ACCESS RVP
DEFDAT NAMES_IN_DATA PUBLIC
EXT BAS (BAS_COMMAND :IN,REAL :IN )
DECL E6POS XP1={@F0:a:c@,@S0@,E1 0.0,E2 0.0,E3 0.0,E4 0.0,E5 0.0,E6 0.0}
DECL FDAT FP1={TOOL_NO 1,BASE_NO 2,IPO_FRAME #BASE,POINT2[] " ",TQ_STATE FALSE}
DECL PDAT PPDAT1={VEL 100.0,ACC 100.0,APO_DIST 100.0}
DECL E6POS XP2={@F1:b:d@,@S1@,E1 12.5,E2 0.0,E3 0.0,E4 0.0,E5 0.0,E6 0.0}
DECL FDAT FP2={TOOL_NO 2,BASE_NO 3,IPO_FRAME #BASE,POINT2[] " ",TQ_STATE FALSE}
DECL E6POS XP3={@F2:b:d@,@S2@}
DECL E6POS XP4={@F3:b:d@,@S3@}
DECL E6AXIS XHOME={@J4@,E1 0,E2 0}
DECL E6POS XUNUSED={X 10,Y 20,Z 30,A 0,B 90,C 0,S 2,T 1}
ENDDAT
""",
    ),
    "loops": (
        """DEF loops()
DECL INT i
BAS(#TOOL, 1)
BAS(#BASE, 2)
FOR i = 1 TO 3
  LIN P[i] C_VEL
ENDFOR
WHILE $IN[1]
  PTP P[1]
  IF $IN[2] THEN
    LIN P[2]
  ELSE
    LIN P[3]
  ENDIF
ENDWHILE
LOOP
  PTP XHOME
  EXIT
ENDLOOP
REPEAT
  LIN P[3]
UNTIL $IN[4]
SWITCH i
  CASE 1
    LIN P[1]
  CASE 2, 3
    LIN P[2]
  DEFAULT
    HALT
ENDSWITCH
END
""",
        """DEFDAT LOOPS
DECL E6POS P[3]
P[1]={@F0:a:c@,@S0@}
P[2]={@F1:a:c@,@S1@}
P[3]={@F2:a:c@,@S2@}
DECL AXIS XHOME={@J5@}
ENDDAT
""",
    ),
    "shifts": (
        """DEF shifts()
$TOOL = TOOL_DATA[1]
$BASE = BASE_DATA[2]
PTP XP1
LIN XP1 : {X 0, Y 0, Z -50, A 0, B 0, C 0}
LIN {X 10, Y -20, Z 0, A 0, B 0, C 5} : XP1 C_DIS
LIN XP1
END
""",
        "DEFDAT SHIFTS\nDECL E6POS XP1={@F0:a:c@,@S0@}\nENDDAT\n",
    ),
    "splines": (
        """DEF splines()
SPTP XP1 WITH $VEL_AXIS[1]=SVEL_JOINT(100.0), $TOOL=STOOL2(FP1), $BASE=SBASE(FP1.BASE_NO)
SPLINE WITH $VEL=SVEL_CP(0.3, ,LCPDAT1), $TOOL=STOOL2(FP1), $BASE=SBASE(FP1.BASE_NO)
  SPL XP2 WITH $TOOL=STOOL2(FP1), $BASE=SBASE(FP1.BASE_NO)
  SPL XP3 WITH $TOOL=STOOL2(FP1), $BASE=SBASE(FP1.BASE_NO)
  TIME_BLOCK START
  SLIN XP4 WITH $TOOL=STOOL2(FP1), $BASE=SBASE(FP1.BASE_NO)
ENDSPLINE
SCIRC XP5, XP6 WITH $TOOL=STOOL2(FP1), $BASE=SBASE(FP1.BASE_NO)
END
""",
        """DEFDAT SPLINES
DECL FDAT FP1={TOOL_NO 1,BASE_NO 2,IPO_FRAME #BASE,POINT2[] " "}
DECL E6POS XP1={@F0:a:c@,@S0@}
DECL E6POS XP2={@F1:a:c@,@S1@}
DECL E6POS XP3={@F2:a:c@,@S2@}
DECL E6POS XP4={@F3:a:c@,@S3@}
DECL E6POS XP5={@F5:a:c@,@S5@}
DECL E6POS XP6={@F6:a:c@,@S6@}
ENDDAT
""",
    ),
    "subroutines": (
        """DEF subroutines()
$TOOL = TOOL_DATA[1]
$BASE = $NULLFRAME
PTP $AXIS_ACT ; BCO
weld()
TRIGGER WHEN DISTANCE=0 DELAY=20 DO $OUT[1]=TRUE
PTP {E6AXIS: @J1@}
END

DEF weld()
PTP {E6POS: @F0:a@, @S0@}
LIN {@F2:a@}
END
""",
        "",
    ),
    "crlf_and_tabs": (
        "DEF crlf()\r\n\tBAS (#TOOL,1)\r\n\tBAS (#BASE,2)\r\n\tptp  {e6pos:  @F0:a:c@,  @S0@}\r\n"
        '\tLIN   {@F1:a:c@}\tC_DIS ; comment {X 1, Y 2}\r\n\tmsgNotify("X 1, {Y 2}")\r\nEND\r\n',
        "",
    ),
    "binary_status": (
        "DEF binary()\n$TOOL=TOOL_DATA[2]\n$BASE=BASE_DATA[3]\nPTP {E6POS: @F0:b:d@, S 'B010', T 'B100010'}\nEND\n",
        "",
    ),
    "robot_root": ("DEF root()\n$TOOL={@T:b@}\n$BASE=$ROBROOT\nPTP {@F4:b@, @S4@}\nPTP {@F7:b@}\nEND\n", ""),
    "joints_only": ("DEF joints()\nPTP {AXIS: @J0@}\nPTP {A1 0,A2 -90,A3 90,A4 0,A5 10,A6 0}\nSPTP {@J3@}\nEND\n", ""),
    "jumps": (
        """DEF jumps()
$TOOL=TOOL_DATA[1]
$BASE=BASE_DATA[2]
again:
LIN {@F0:a:c@}
IF $IN[1] THEN
  GOTO again
ENDIF
LIN {@F1:a:c@}
END
""",
        "",
    ),
    "assigned": (
        """DEF assigned()
DECL E6POS HERE, THERE
$TOOL=TOOL_DATA[1]
$BASE=BASE_DATA[2]
HERE = {@F0:a:c@, @S0@}
THERE = HERE
PTP HERE
LIN THERE
END
""",
        "",
    ),
}

REFUSED: dict[str, tuple[str, str, int, str]] = {
    "relative": ("DEF a()\n$TOOL=$NULLFRAME\n$BASE=$NULLFRAME\nLIN_REL {Z 50}\nEND\n", "", 4, "relative"),
    "by_parts": (
        "DEF a()\n$TOOL=$NULLFRAME\n$BASE=$NULLFRAME\nXP1.Z=XP1.Z+50\nLIN XP1\nEND\n",
        "DEFDAT A\nDECL E6POS XP1={@F0@}\nENDDAT\n",
        4,
        "by parts",
    ),
    "variable_shift": (
        "DEF a()\nDECL FRAME off\n$TOOL=$NULLFRAME\n$BASE=$NULLFRAME\noff = lift(3)\nLIN XP1:off\nEND\n",
        "DEFDAT A\nDECL E6POS XP1={@F0@}\nENDDAT\n",
        5,
        "when the program runs",
    ),
    "partial": ("DEF a()\n$TOOL=$NULLFRAME\n$BASE=$NULLFRAME\nPTP {A1 30}\nEND\n", "", 4, "A1 alone"),
    "unknown": ("DEF a()\n$TOOL=$NULLFRAME\n$BASE=$NULLFRAME\nPTP XHOME\nEND\n", "", 4, "no numbers in this program"),
    "parameter": ("DEF a(P :IN)\nDECL E6POS P\nBAS(#TOOL,1)\nBAS(#BASE,2)\nLIN P\nEND\n", "", 5, "no numbers"),
    "angle_of_circle": (
        "DEF a()\nBAS(#TOOL,1)\nBAS(#BASE,2)\nCIRC {@F0:a:c@}, {@F1:a:c@}, CA 270\nEND\n",
        "",
        4,
        "angle",
    ),
    "external_base": (
        "DEF a()\n$TOOL=TOOL_DATA[1]\n$BASE=EK(MACHINE_DEF[2].ROOT,MACHINE_DEF[2].MECH_TYPE,{X 0})\nLIN {@F0@}\nEND\n",
        "",
        4,
        "external kinematic",
    ),
    "two_tools": (
        "DEF a()\nBAS(#TOOL,1)\nBAS(#BASE,2)\nLIN XP1\nBAS(#TOOL,2)\nLIN XP1\nEND\n",
        "DEFDAT A\nDECL E6POS XP1={@F0:a:c@}\nENDDAT\n",
        4,
        "for the same target",
    ),
    "tool_in_branch": (
        "DEF a()\nBAS(#TOOL,1)\nBAS(#BASE,2)\nIF $IN[1] THEN\nBAS(#TOOL,2)\nENDIF\nLIN {@F0:a:c@}\nEND\n",
        "",
        7,
        "differs between the ways",
    ),
    "fixed_tool": (
        "DEF a()\nFDAT_ACT=FP1\nLIN {@F0@}\nEND\n",
        "DEFDAT A\nDECL FDAT FP1={TOOL_NO 1,BASE_NO 2,IPO_FRAME #TCP}\nENDDAT\n",
        3,
        "#TCP",
    ),
    "handed_over": (
        "DEF a()\nBAS(#TOOL,1)\nBAS(#BASE,2)\nGRIPP(XP1)\nEND\n",
        "DEFDAT A\nDECL E6POS XP1={@F0:a:c@}\nENDDAT\n",
        4,
        "handed to",
    ),
    "out_of_reach": ("DEF a()\nBAS(#TOOL,1)\nBAS(#BASE,2)\nLIN {X 9000,Y 0,Z 0,A 0,B 0,C 0}\nEND\n", "", 4, "reach"),
}
