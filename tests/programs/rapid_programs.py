"""Modules in RAPID."""

HEAD = """  TASK PERS tooldata tGrip:=[TRUE,[@T:a@],[1,[0,0,1],[1,0,0,0],0,0,0]];
  PERS wobjdata wTable:=[FALSE,TRUE,"",[@B:c@],[[0,0,0],[1,0,0,0]]];
"""
C = "[0,0,0,0],[9E+09,9E+09,9E+09,9E+09,9E+09,9E+09]"


def module(body: str, data: str = "") -> str:
    return f"MODULE Test\n{HEAD}{data}  PROC main()\n{body}  ENDPROC\nENDMODULE\n"


GOOD: dict[str, str] = {
    "in_place": module(
        f"""    ConfJ \\Off;
    MoveAbsJ [@J0@,[9E9,9E9,9E9,9E9,9E9,9E9]]\\NoEOffs,v1000,fine,tGrip;
    MoveJ [@F1:a:c@,{C}],v1000,z50,tGrip\\WObj:=wTable;
    MoveL [@F2:a:c@,{C}], v100\\V:=50, fine\\Inpos:=inpos50, tGrip \\WObj:=wTable;
    MoveC [@F3:a:c@,{C}],[@F5:a:c@,{C}],v100,z1,tGrip\\WObj:=wTable;
"""
    ),
    "arc_moves": module(
        f"""    ArcMoveAbsJ [@J0@,[9E9,9E9,9E9,9E9,9E9,9E9]]\\NoEOffs,v1000,z10,tGrip;
    ArcMoveJ [@F1:a:c@,{C}],v1000,z50,tGrip\\WObj:=wTable;
    ArcMoveC [@F3:a:c@,{C}],[@F5:a:c@,{C}],v100,z1,tGrip\\WObj:=wTable;
"""
    ),
    "named": module(
        """    MoveJ p10,v1000,z50,tGrip\\WObj:=wTable; ! approach p20:=[[1,2,3]]
    MoveL p20,v100,fine,tGrip\\WObj:=wTable;
    MoveAbsJ home\\NoEOffs,v200,fine,tGrip;
""",
        f"""  CONST robtarget p10:=[@F0:a:c@,{C}];
  LOCAL PERS robtarget p20:=[@F1:a:c@,{C}];
  CONST jointtarget home:=[@J2@,[9E9,9E9,9E9,9E9,9E9,9E9]];
  CONST robtarget unused:=[[1,2,3],[1,0,0,0],{C}];
""",
    ),
    "offsets": module(
        """    MoveJ Offs(p10,0,0,100),v1000,z50,tGrip\\WObj:=wTable;
    MoveL p10,v100,fine,tGrip\\WObj:=wTable;
    MoveL RelTool(p10,0,10,-50\\Rx:=5\\Rz:=-30),v100,fine,tGrip\\WObj:=wTable;
    MoveL Offs(p10, -20, 2*15, 100), v100, fine, tGrip\\WObj:=wTable;
""",
        f"  CONST robtarget p10:=[@F0:a:c@,{C}];\n",
    ),
    "loops": module(
        """    FOR i FROM 1 TO 2 DO
      MoveL pts{i},v100,fine,tGrip\\WObj:=wTable;
    ENDFOR
    WHILE di1=1 DO
      IF n>3 THEN
        MoveJ pts{1},vmax,z10,tGrip\\WObj:=wTable;
      ELSEIF n=2 MoveJ pts{2},vmax,z10,tGrip\\WObj:=wTable;
      ENDIF
    ENDWHILE
    TEST n
    CASE 1:
      MoveL pts{2},v100,fine,tGrip\\WObj:=wTable;
    DEFAULT:
      Stop;
    ENDTEST
""".replace("      ELSEIF n=2 MoveJ", "      ELSE\n        MoveJ"),
        f"  CONST robtarget pts{{2}}:=[[@F0:a:c@,{C}],[@F1:a:c@,{C}]];\n  VAR num n:=1;\n",
    ),
    "triggers": module(
        f"""    TriggIO gun,10\\DOp:=do1,1;
    TriggL [@F0:a:c@,{C}],v100,gun,fine,tGrip\\WObj:=wTable;
    TriggC [@F1:a:c@,{C}],[@F2:a:c@,{C}],v100,gun,z1,tGrip\\WObj:=wTable;
    MoveLDO [@F3:a:c@,{C}],v100,z10,tGrip\\WObj:=wTable,do2,1;
    MoveLSync [@F5:a:c@,{C}],v100,z10,tGrip\\WObj:=wTable,"proc1";
"""
    ),
    "search": module(
        f"    SearchL \\Stop,di1,found,[@F0:a:c@,{C}],v50,tGrip\\WObj:=wTable;\n", "  VAR robtarget found;\n"
    ),
    "welding": module(
        f"""    ArcLStart [@F0:a:c@,{C}],v100,seam1,weld1\\Weave:=weave1,fine,tGrip\\WObj:=wTable;
    ArcC [@F1:a:c@,{C}],[@F2:a:c@,{C}],v100,seam1,weld1,z1,tGrip\\WObj:=wTable;
    ArcLEnd [@F3:a:c@,{C}],v100,seam1,weld1,fine,tGrip\\WObj:=wTable;
"""
    ),
    "no_work_object": module(
        f"    MoveL [@F0:a@,{C}],v100,fine,tGrip;\n    MoveJ [@F1@,{C}],v100,fine,tool0\\WObj:=wobj0;\n"
    ),
    "tool_of_another_module": module(f"    MoveL [@F0:b:d@,{C}],v100,fine,tOther\\WObj:=wOther;\n"),
    "external_axes": module(
        """    MoveL [@F0:a:c@,[0,0,-1,0],[120.5,9E9,9E9,9E9,9E9,9E9]],v100,fine,tGrip\\WObj:=wTable;
    MoveExtJ park,vrot10,z50;
""",
        "  CONST jointtarget park:=[[9E9,9E9,9E9,9E9,9E9,9E9],[0,9E9,9E9,9E9,9E9,9E9]];\n",
    ),
    "crlf_latin": module(
        f'    ! größe\n    TPWrite "MoveL p10, v100; größe";\n    MoveL [@F0:a:c@,{C}],v100,fine,tGrip\\WObj:=wTable;\n'
    ).replace("\n", "\r\n"),
    "routines": f"""%%%
  VERSION:1
  LANGUAGE:ENGLISH
%%%

MODULE Parts
{HEAD}  CONST robtarget p10:=[@F0:a:c@,{C}];
  PROC main()
    pick;
    place\\Fast;
  ENDPROC
  PROC pick()
    MoveL p10,v100,fine,tGrip\\WObj:=wTable;
  ENDPROC
  PROC place(\\switch Fast)
    VAR robtarget here;
    here:=p10;
    MoveL here,v100,fine,tGrip\\WObj:=wTable;
  ENDPROC
ENDMODULE
""",
}

REFUSED: dict[str, tuple[str, int, str]] = {
    "literal_handed_over": (module(f"    rPlace [@F0:a:c@,{C}],5;\n"), 5, "handed to 'rPlace'"),
    "variable_offset": (
        module(
            "    MoveL Offs(p10,0,0,nHeight),v100,fine,tGrip\\WObj:=wTable;\n",
            f"  CONST robtarget p10:=[@F0:a:c@,{C}];\n",
        ),
        6,
        "by variables",
    ),
    "current": (
        module("    p1:=CRobT(\\Tool:=tGrip);\n    MoveL Offs(p1,0,0,10),v10,fine,tGrip;\n", "  VAR robtarget p1;\n"),
        6,
        "when the program runs",
    ),
    "displaced": (
        module(f"    PDispSet frame1;\n    MoveL [@F0:a:c@,{C}],v100,fine,tGrip\\WObj:=wTable;\n"),
        5,
        "displacement",
    ),
    "corrected_path": (module(f"    MoveL \\Corr,[@F0:a:c@,{C}],v100,fine,tGrip;\n"), 5, "Corr"),
    "by_parts": (
        module(
            "    p10.trans.z:=500;\n    MoveL p10,v100,fine,tGrip\\WObj:=wTable;\n",
            f"  VAR robtarget p10:=[@F0:a:c@,{C}];\n",
        ),
        6,
        "by parts",
    ),
    "star": (module("    MoveL *,v100,fine,tGrip\\WObj:=wTable;\n"), 5, "not in the text"),
    "elsewhere": (module("    MoveL pElse,v100,fine,tGrip\\WObj:=wTable;\n"), 5, "no numbers"),
    "parameter": (
        f"MODULE M\n{HEAD}  PROC go(robtarget p)\n    MoveL p,v100,fine,tGrip;\n  ENDPROC\nENDMODULE\n",
        5,
        "no numbers",
    ),
    "handed_over": (module("    myMove p10;\n", f"  CONST robtarget p10:=[@F0:a:c@,{C}];\n"), 6, "handed to"),
    "moving_object": (
        module(
            f"    MoveL [@F0@,{C}],v100,fine,tGrip\\WObj:=wTurn;\n",
            '  PERS wobjdata wTurn:=[FALSE,FALSE,"STN1",[[0,0,0],[1,0,0,0]],[[0,0,0],[1,0,0,0]]];\n',
        ),
        6,
        "mechanical unit",
    ),
    "fixed_tool": (
        module(
            f"    MoveL [@F0@,{C}],v100,fine,tFixed;\n",
            "  PERS tooldata tFixed:=[FALSE,[[0,0,0],[1,0,0,0]],[1,[0,0,1],[1,0,0,0],0,0,0]];\n",
        ),
        6,
        "robhold FALSE",
    ),
    "tool_changed": (
        module(f"    tGrip.tframe.trans.z:=100;\n    MoveL [@F0:a@,{C}],v100,fine,tGrip;\n"),
        6,
        "changed while",
    ),
    "search_result": (
        module(
            f"    SearchL \\Stop,di1,pf,[@F0:a@,{C}],v50,tGrip;\n    MoveL pf,v50,fine,tGrip;\n",
            "  VAR robtarget pf;\n",
        ),
        6,
        "search",
    ),
}
