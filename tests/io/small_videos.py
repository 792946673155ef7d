"""Videos of six frames, whose grey levels are 30, 48 … 120, shown at uneven times; packed."""

from __future__ import annotations

import base64
import zlib

TIMES_S = [0.0, 0.04, 0.08, 0.5, 0.54, 2.0]
GREYS = [30, 48, 66, 84, 102, 120]

# By suffix: H.264 with B-frames (mkv, mp4), MPEG-4, VP9 and FLV1; 25 frames a second are announced.
_PACKED = {
    "mkv": (
        "c-pO0{cjUx9Di<ZZ0-lyAi622PlP1~xAyvC!Np6~c8$z2M(8#ZBRQYmUE8DW-R<tWwTs5xR$(%e5j7CT7#U4Sh"
        "zpS!UE)GoW;8;G;THl#4Kv~ki2*?)7y{?_X@~m<eA3?Yef@kt-{<YA(A9iCu*YHoci?~9sto*T)dWVyQpD6%BS"
        "8Xt!St?G(HI_%F^G<;&GlV}&0-<f*>s|%YhgV6aqjVs6VdRjHB;7}=sB4H?R?k5`=G7q`7#!s9bqD6b$xgNoFi"
        "51elMe;F#7)o<#W7{8>&9ux#`lW(ba*ruHoD^G7x>uUz*zA8*4kdR0^eJ+x8c7>cy{@PA*fjE?JE6)z~r^Gi9O"
        "YKARd%E8>`i_DuBgT{}Xrc%2>LZl}L5IBGE)ej3eHL|#Wr`#!Po7Z&cBvnqRUSm<Gk6$lB(W*HIH+CQR(7|gQ+"
        "^-VJfJ%S*j`oiipO}RH2v?~5vaH4tq{@uHXF4{sNxA^lLMZ=gAisQlxo!B=sq5N2T?@oVDNB8#jy&tk{EB(10t"
        "d}hh^lb3+bkHc|<lg@4zgj3CIBg*`3{0k1RoV9B_o3^jf4Q=C{y_6(d}YIpn;Eyyi(9au>JoPOUIcNg158fZXp"
        "0v^m*5j60USY9%O<6$iQO#gX>qe|8XY%Ht<~uq92|5E$fBesiQ-W8n3Li<;$|udF{)<Ds$#TafkcSFxv(xpIhP"
        "NMQY5Jg3C`6DJz%1cWY&;4Hsfh!GcJz@rz9?&ien=k0m;Q;&B#JBe0g2uTn^efd~iz6NFratgcM#UN=)M1UM$3"
        "QHAQ%ui%nfhCS`+j<1LvjqF{na=udGha3JE4sz8FP+2z7fVwk*UBxH?7lmYrRUX4Z#$>dtx*o^CtVSqQOstFPY"
        "g<r85Nm-Cq3@ldkQVl_dOGSCeiYe(y0zqJpB-1*{@`9SuhzYs?i)89VRsaG5bwXpJI!Q^Cc!bxoAj@J&CL+<yk"
        "`$2%tt8621bun%pd`oQW(10<nxybCRReF?s6j$P$^tg$TNe0~tWe^Dq)0;A<h(2{m8R>dOGX@Wb%Fn{SIE-^PS"
        "B$`6@fLSErG(hJq{N4(?&Sf;R8{lu%($~INwVk7^b9gUMy>{L2w*k|DY7<hs~!uNlz$RE5R+RwIBR#yj8n9G}3"
        "dbPq?2yYM~wU@HhA;YYx|S+LzyXaM7?A`+T>~9r-qNr<gxtq326CpP8=P?swk1X3y{X;j!Iy6W^WRb@og?Z&j?"
        "P?sfjj`i7;pvmY(i+Dk#3kK1Q58;3Ve{Zo0fn4h+oze-O6Gu?P@f46<F(Vm~<Ufn$Y^ri#P)Mf#s`oc2ElRGnY"
        "FCW@g^TI<E^HA{v<J#H+eclcha&HgazPd2+sfFhE!Lxd6ggN$y_2|F%h}by"
    ),
    "mp4": (
        "c-nnbUuYaf7@td;7=mbOqe*MDBTYeS?r!()de-2|g(Dc$s)**PVV#?qyWQUY%go&6t_a5BgHW&{QfSnG&x)Wg!"
        "3VJ|zO+d3MQBl>LXrAn@kJ}8UBB78c$a89?Ckf=_kF+boA1vqLI_t?J91^{BQ$_Cg`Fc!YWh*ZL<o&k1?LD29`"
        "+egV6#3v6vt~n&HwiGua_4#PR(4xm-qdCy_G8#a2nH4aBLP20=tj_QTFi5^UtOWcy6%_I>sp|%3;*@cvaz?VdT"
        ">}Bd4t$rJ~tvc4cKH({vdRJrZO>QOjz-8AtgZ*o2XC!$8hrN-Bg}CKkMEnMKTa#S3ZOGG~oh1CxMwZOJX8m7g_"
        "QW<HO7ZZ&)d%SHt_)4-8z0~p@6V3wIN00l4XyDiS_#3w*(L4q2$as^Bs5&Fc|SgZv1JXcyde5iGZQ3WEp>{|xh"
        "fv{s?0048wG;x(kWk<5^M%tp|U^%kGYE^P&rE^$00uU0kUKrMi0|&b&lb%a?Phj9cBr&M#6Q%Fr28s)hfDy<mU"
        "PF+!O+!B-3eFUYqy%vTZ~=ybXq&1aKGzqo*ijpJmnA%5BvJ`iafyz^T)`o)JYL~$%~2Hy7Dha<YheW1jxYj1ow"
        "vcaRqQgh?*{tfln0zPlvOZr5?a?&aOnV6Q2XCp0Vk+MMHTxMsHsi~4puIoG4QfZ#4<8PU?c4|p`>LMp8`fI9$5"
        "wKM$jM_2k0M!BFoTx-AS|x6T6GQ^A;M7Z~rOZ7(F_F{M9cO=`9dX%&m=lIQD#e>CM|e$oSl1@sA51U!4Ez45%J"
        "Vt&hDpm%Vv4-dOtizN2F&fBbIg{8>;uJh!%U;!5fK2j@oPE9KaB;<K&k)#;D^-f>;y9!jlGUU=`N_~vB1@ul_L"
        "lP4ZIaO%;~b_clomDbqPr(YO(ViT!OpLt(i-SrK8Oh^1MY=W8RHywtytifvt-E#w_kbZhAwbg3-xrFYz2H^P=+"
        "EEAoh^i+s2mk90;-b69`QNy>yAhh^Oi7?q+>@$@(0+%y*nxdMbBRXyY<up{K>LoP*S<{-X@_}YQ=@+h{g#XRC$"
        "T^R=5cM4x(I_(1!lbICr<mXIn6q{DF(yXm&Uyf;o%OSdRMB72mI$!N!DkxuK$F0D1}ZMqXnP~ceL2PCgT|11@K"
        "x<F&NTc&_oUBXU(1aKhZ7G#rppK2ll`HdI}9Y*UBenPTabYbY&bqlx|567+r6VOO=!xb=$cE%DdXR$DUG$Cg*X"
        ";O7`7R?-K1{hdZ*N&33K!VS(-~ZS}dNXMYNO(rrGwe$Wi)j`d{?@`11PR{?uB?7gt}bSd18hJAi?ZdQXSJt7Bv"
        "o>09W>mLUgAwi<Z>o4ty3p4i*HTIYG"
    ),
    "mov": (
        "c-muNU=T?wsVpcgQBYuDU}AvK3>@W|DXBpEU~Woc2?GP;W(EOvAhk_^nW;xqcYp7;zYGkA+_<LQKX$tgS$Z*Zk"
        "2o(x`mh^!8=ADBGh2`Dwtr@~zcVl#a}&E=FP-}vNm~3eXHUfKAGh=GGccTV)5-mlyZt?qv_vsa&*uEcx%=xG7|"
        "yswZvVLL{(gvbJH%=Hy=D*#&%4crs$=HM&Cf3bdL$>eEF*;h1u(y0U||2jz{mhX2*8M{3Z3u3fEO?U(X5i9#B3"
        "ltrX(9|Co`sLKzkYR+k@3!1t?}<P)SWGDF)IqsX4_Z2pv#!!Frj5a#J!BK{|3%(EV=Lz`#)7Q2!sy(alK7DFQK"
        "aGjfW`AQ2A-JYhhAe2>Jul$=zcBF4SBnR#hIagnlIu%XD#)PWh40yL<!C`SR=Aa0k$l0>*U3@RxQb7WGAQqz#U"
        "%mdX2ik86QlB66Uduwq?aSD=}rMU$rWyrzg=H?p!4to$*074HS(*sAqVgiZ(pn&jCElw#0Cya)M20NfO79ee)A"
        "P9-qt00mUC?W?maRbP8TRVjzhBGQK9O><lcV%Q@5piY%Dq#e<#G<$a97AAz(3H^tagLM&gog2>k@+$}&n6=|9f"
        "aASv<^_N3d!Lhad|9Q4irJfCCT|n=BNMw-0z`O"
    ),
    "webm": (
        "c-oV4y}x+AQ(GgW({~{L)X3uWxsk)EsiizMDc7mJk;$pGkx3%BA)S!{1eh2EeP@^K^4;AXyt+lyb7flan#P3?o"
        "><7bY#{HL@9rKTPblPYdhnViMotJ<CU|!?i2Ldd#2ki523i4-s}^Wo-`LFW<lx)T;*(gG7VZe9Tsk`(=05-{0y"
        "%cyI;dMruQxIlAMJqZXPnc>ptN;Pb7@{mM<YX9Ygl|(fMs(dqw?eC7N(>qh6imM8WnamDu8^rwYYdw@`3JTgy!"
        "@U3tbm?xP%5dhIsn>xwKC<Ft7q4BRvBX0|;P{civX&u<&^!!{P;v3=9oTp3P1Sj2{@kF<7X`NO&<Y7$h(-2;Be"
        "w`$z)A;^~bH8Vqd=4wL3E1TZi#17#%l|9{*7mI#1K_&tD0y!!x>VElqZ2a^m~;sc{80|O6Gf|2?E(*TCW(;C??"
        "KqVYt5|<t@fZ}Z8?*7e<4BNYaY2#xPqw|MGW&rx8q_q"
    ),
    "flv": (
        "c-nLG31ehrU|`?`Vg?}whWQK-z{J3npXZxelIW6HlE?uRU}xY+DJ@DY$;{7Va9{|0-72>uh=H{{Go>Vh!NCEli"
        "!CEHGd-gOA;4RfnUb2H0yG1tHI)GlIMa#}b5p@$4wg_c9<bWv{FKz>%oGNg2@D)*nK`M&nN>iQbp<f(K)eb_C`"
        "0)`hqo{Y2nec$goK3t|8KNt(W3SLe@+z@6|Mh&X2psXtN;H2s?vk#&_LF)tf;7{`2T<7$&)9~|NnCi5d8mt=E;"
        "*M&yjTmAn6cRn>1<C<p2Lorc9Xv)UgBz{{KI#s;a7vq=WGbk`9q&8#Zj%`2W9YYin!&|DS7gbad+fpG{0mOh(e"
        "dB!i?wOzpyj3m5<YH*0Ha1M1jfVqyZ+v2fwS#Yj5XFCgg<U-s_ZyZ8V9o0pfD*Z=>y8wh}|x_kHTeTWVKgrA$j"
    ),
}


def video(suffix: str) -> bytes:
    """The file."""
    return zlib.decompress(base64.b85decode(_PACKED[suffix]))


# Six pictures of 64 × 48 pixels, grey 30, 60 … 180; the first and the fourth need none before them.
_STREAMS = {
    "h264": (
        "00001XJh~hth6K0fB*mk0Du4h9!H52Pyhe`0ch_J%K!iYWr&0XzvTY~;QsVGU26mW`^SE1l|psd2DH=h5b|Qg?E",
        "00001L7FE((1QQ|+Nu@",
        "00001L7GQE$b$d=+Nu`",
        "00001XJh~hth6K0fB*mk0Du4h9!H52Pyhe`0ch_J%K!iYWr%_Sf9(IlRsY!b5-b1Te7Wm+a>Ui(HYv(JxjXb7_y",
        "00001L7FE((1QQ|+Nu`",
        "00001L7GQE(1QQ|+Nu`",
    ),
    "h265": (
        "00001KmiN^|NjAC00093kN^M!000939=ZZR00001LID8*U;qFE0FVFx0{{R603M(qgBDw>lPj76000930ssI"
        "506Y)?0003*0l{<7i2wirC;_i{_+9t^_1y2XR%dI#",
        "000010s+toekmpnh!eo-+br+",
        "000010s+tw|J0<04u}&#>f0>v",
        "00001KmiN^|NjAC00093kN^M!000939=ZZR00001LID8*U;qFE0FVFx0{{R603M(qgBDw>lPj76000930ssI"
        "506Y)?0003*0l{<7i2wirDgmqv^};B*DU5&h&4%Ynb%r)>",
        "000010s+t=elnOmAW!PsEbs",
        "000010s+t||J2GDJ|Io%+br+",
    ),
}


def stream(name: str) -> list[bytes]:
    """The pictures of ``h264`` or ``h265``, one message each."""
    return [base64.b85decode(part) for part in _STREAMS[name]]
